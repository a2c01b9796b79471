"""Optical flow on joints of BADJA, carried from one annotated frame to the next, beside OpenCV's methods.

PCK@0.2: share of joints that land within 0.2 sqrt(area of the true mask) of where they are (Biggs et al. 2018).
OpenCV's methods are chained frame by frame. What `estimate_flow` stores has pairs further apart and confidences:
`most_certain` picks among their paths, and DIS gets the same pairs and the same choice as one more peer.
"""

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from benchmarks.real import davis
from benchmarks.real.davis import DavisSequence
from benchmarks.real.table import Row
from pipeline.core.progress import log
from pipeline.data import images
from pipeline.data.flow import GAPS, open_confidence, open_flow
from stages.estimate_flow.estimation import TOLERANCE_PX

Points = Float[np.ndarray, "point 2"]
"""x, y, pixels"""
Dense = Float[np.ndarray, "height width 2"]
Carry = Callable[[Points, int, int], Points]
"""From points in a frame, that frame and a later one to where the points are then"""
Step = Callable[[int, int], Dense]
"""From a frame and another to the dense flow between them, in pixels"""
CertainStep = Callable[[int, int], tuple[Dense, Float[np.ndarray, "height width"]]]
"""The same, with confidence, 0..1"""
BASELINES = ("OpenCV DIS", "OpenCV Farneback")
"""Methods that the bar names"""
SHARES = (0.2, 0.1, 0.05)
FARNEBACK = (0.5, 5, 15, 3, 7, 1.5, 0)
"""Ratio of the pyramid, its levels, window, iterations, neighbourhood and smoothing of the polynomial, flags."""
MIN_CONFIDENCE = 1 / 255
"""what a stored 0 counts, that paths through it still differ"""


def chained(step: Step) -> Carry:
    """Carry points from frame to frame."""

    def carry(points: Points, first: int, last: int) -> Points:
        for frame in range(first, last):
            points = points + sampled(step(frame, frame + 1), points)
        return points

    return carry


def most_certain(step: CertainStep) -> Carry:
    """Carry each point along the path over pairs 1, 2, 4 and 8 apart whose confidences have the largest product.

    Point by point that is Viterbi's algorithm over frames.
    """

    def carry(points: Points, first: int, last: int) -> Points:
        place, certainty = {first: points}, {first: np.ones(len(points))}
        for frame in range(first + 1, last + 1):
            ends, products = [], []
            for before in (frame - gap for gap in GAPS if frame - gap >= first):
                flow, confidence = step(before, frame)
                at = place[before]
                ends.append(at + sampled(flow, at))
                products.append(certainty[before] * np.maximum(sampled(confidence, at), MIN_CONFIDENCE))
            best, each = np.argmax(products, axis=0), np.arange(len(points))
            place[frame], certainty[frame] = np.array(ends)[best, each], np.array(products)[best, each]
        return place[last]

    return carry


def sampled(image: np.ndarray, points: Points) -> np.ndarray:
    """Read an image between its pixels."""
    return sampled_densely(image, points[None])[0]


def sampled_densely(image: np.ndarray, at: Dense) -> np.ndarray:
    """Read an image between its pixels, at a picture of places."""
    x, y = np.moveaxis(at.astype(np.float32), -1, 0)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def errors(carry: Carry, sequence: DavisSequence) -> Float[np.ndarray, "joint"]:
    """Return how far joints that both frames of a pair show are carried beside where they are, by the square
    root of the true mask's area.
    """
    joints, found = sequence.joints_by_frame(), [np.zeros(0)]
    for first, last in pairwise(sorted(joints)):
        both = joints[first].visible & joints[last].visible
        if both.any():
            there = carry(joints[first].position_px[both], first, last)
            error = np.linalg.norm(there - joints[last].position_px[both], axis=-1)
            found.append(error / np.sqrt(sequence.mask(last).sum()))
    return np.concatenate(found)


def stored(folder: Path, size: tuple[int, int]) -> CertainStep:
    """Read what `estimate_flow` wrote, at every pixel of (height, width)."""
    tables = {gap: (open_flow(folder, gap), open_confidence(folder, gap)) for gap in GAPS}

    def step(first: int, last: int) -> tuple[Dense, Float[np.ndarray, "height width"]]:
        flow, confidence = (table[first].astype(np.float32) for table in tables[last - first])
        return cv2.resize(flow, size[::-1]), cv2.resize(confidence, size[::-1]) / 255

    return step


def both_ways(step: Step) -> CertainStep:
    """Judge a flow as `estimate_flow` does, by how far going there and back misses."""

    def judged(first: int, last: int) -> tuple[Dense, Float[np.ndarray, "height width"]]:
        there, back = step(first, last), step(last, first)
        x, y = np.meshgrid(*(np.arange(side) for side in there.shape[1::-1]))
        missed = there + sampled_densely(back, there + np.stack([x, y], axis=-1))
        return there, np.exp(-np.linalg.norm(missed, axis=-1) / TOLERANCE_PX).astype(np.float32)

    return judged


def methods(sequence: DavisSequence, flow: Path) -> dict[str, Carry]:
    """Return ours, as `estimate_flow` wrote it, OpenCV's, and none at all."""
    size = sequence.mask(0).shape
    gray = [cv2.cvtColor(images.read_color(path), cv2.COLOR_RGB2GRAY) for path in sequence.pictures]
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    empty = np.zeros((*size, 2), np.float32)
    ours = stored(flow, size)

    def dis(first: int, last: int) -> Dense:
        return search.calc(gray[first], gray[last], empty.copy())

    def farneback(first: int, last: int) -> Dense:
        return cv2.calcOpticalFlowFarneback(gray[first], gray[last], empty.copy(), *FARNEBACK)

    return {
        "ours": most_certain(ours),
        "ours, frame by frame": chained(lambda first, last: ours(first, last)[0]),
        "OpenCV DIS": chained(dis),
        "OpenCV DIS, our pairs and choice": most_certain(both_ways(dis)),
        "OpenCV Farneback": chained(farneback),
        "no motion": lambda points, first, last: points,
    }


def measured(sequence: DavisSequence, folder: Path) -> dict[str, list[float]]:
    """Return the PCK at all shares of all methods on one sequence."""
    done = folder / "pck.json"
    if not done.is_file():
        flow = davis.flow(davis.frames(sequence, folder / "frames"), folder / "flow")
        found = {}
        for name, carry in methods(sequence, flow).items():
            error = errors(carry, sequence)
            found[name] = [float((error < share).mean()) for share in SHARES]
        done.write_text(json.dumps(found) + "\n")
    found = json.loads(done.read_text())
    log(
        f"{sequence.name}: PCK@{SHARES} { ({name: np.round(value, 3).tolist() for name, value in found.items()}) }"
    )
    return found


def row(data: Path, out: Path) -> Row:
    """Measure all sequences that have joints."""
    each = {
        name: measured(sequence, out / "davis" / name)
        for name, sequence in davis.animals(data).items()
        if sequence.joints is not None
    }
    names = list(next(iter(each.values())))
    cells = {
        name: ", ".join(" / ".join(f"{share:.3f}" for share in values[name]) for values in each.values())
        for name in names
    }
    met = all(values["ours"][0] > values[baseline][0] for values in each.values() for baseline in BASELINES)
    return Row(
        "flow",
        f"DAVIS with BADJA joints: {', '.join(each)}",
        " / ".join(f"PCK@{share}" for share in SHARES),
        cells.pop("ours"),
        cells,
        {},
        "above DIS and Farneback on every sequence",
        met,
        {"pck": each},
    )
