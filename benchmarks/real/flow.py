"""Optical flow evaluated by propagating BADJA joints between annotated frames, compared with OpenCV.

PCK@0.2: fraction of joints within 0.2 sqrt(area of the true mask) of their annotation (Biggs et al. 2018). The methods
of OpenCV are chained frame by frame. `estimate_flow` also stores pairs several frames apart with confidences, among
which `most_certain` selects a path per point; DIS with the same pairs and selection is a further baseline.
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
Propagation = Callable[[Points, int, int], Points]
"""From (points in the first frame, first frame, last frame) to the points in the last frame"""
Step = Callable[[int, int], Dense]
"""From two frames to the dense flow between them, in pixels"""
ConfidentStep = Callable[[int, int], tuple[Dense, Float[np.ndarray, "height width"]]]
"""The same, with confidence, 0..1"""
BASELINES = ("OpenCV DIS", "OpenCV Farneback")
"""Methods that must be outperformed"""
THRESHOLDS = (0.2, 0.1, 0.05)
FARNEBACK = (0.5, 5, 15, 3, 7, 1.5, 0)
"""Pyramid scale, levels, window size, iterations, polynomial neighborhood and sigma, flags."""
MIN_CONFIDENCE = 1 / 255
"""lower bound of stored confidences, so that products stay comparable"""


def chained(step: Step) -> Propagation:
    """Propagate points from frame to frame."""

    def propagate(points: Points, first: int, last: int) -> Points:
        for frame in range(first, last):
            points = points + sample_points(step(frame, frame + 1), points)
        return points

    return propagate


def most_certain(step: ConfidentStep) -> Propagation:
    """Propagate each point along the path over pairs 1, 2, 4 and 8 frames apart with the largest product of confidences.

    The best path is found by the Viterbi algorithm, per point.
    """

    def propagate(points: Points, first: int, last: int) -> Points:
        position, certainty = {first: points}, {first: np.ones(len(points))}
        for frame in range(first + 1, last + 1):
            ends, products = [], []
            for before in (frame - gap for gap in GAPS if frame - gap >= first):
                flow, confidence = step(before, frame)
                at = position[before]
                ends.append(at + sample_points(flow, at))
                products.append(certainty[before] * np.maximum(sample_points(confidence, at), MIN_CONFIDENCE))
            best, each = np.argmax(products, axis=0), np.arange(len(points))
            position[frame], certainty[frame] = np.array(ends)[best, each], np.array(products)[best, each]
        return position[last]

    return propagate


def sample_points(image: np.ndarray, points: Points) -> np.ndarray:
    """Sample an image bilinearly at points."""
    return sample_grid(image, points[None])[0]


def sample_grid(image: np.ndarray, at: Dense) -> np.ndarray:
    """Sample an image bilinearly at a dense grid of positions."""
    x, y = np.moveaxis(at.astype(np.float32), -1, 0)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def errors(propagate: Propagation, sequence: DavisSequence) -> Float[np.ndarray, "joint"]:
    """Return the errors of joints that are visible in both frames of a pair, relative to the square root of the area of
    the true mask.
    """
    joints, found = sequence.joints_by_frame(), [np.zeros(0)]
    for first, last in pairwise(sorted(joints)):
        both = joints[first].visible & joints[last].visible
        if both.any():
            predicted = propagate(joints[first].position_px[both], first, last)
            error = np.linalg.norm(predicted - joints[last].position_px[both], axis=-1)
            found.append(error / np.sqrt(sequence.mask(last).sum()))
    return np.concatenate(found)


def stored_flow(folder: Path, size: tuple[int, int]) -> ConfidentStep:
    """Return the output of `estimate_flow`, upsampled to (height, width)."""
    tables = {gap: (open_flow(folder, gap), open_confidence(folder, gap)) for gap in GAPS}

    def step(first: int, last: int) -> tuple[Dense, Float[np.ndarray, "height width"]]:
        flow, confidence = (table[first].astype(np.float32) for table in tables[last - first])
        return cv2.resize(flow, size[::-1]), cv2.resize(confidence, size[::-1]) / 255

    return step


def with_consistency(step: Step) -> ConfidentStep:
    """Add confidences by forward-backward consistency, as `estimate_flow` does."""

    def checked(first: int, last: int) -> tuple[Dense, Float[np.ndarray, "height width"]]:
        forward, backward = step(first, last), step(last, first)
        x, y = np.meshgrid(*(np.arange(side) for side in forward.shape[1::-1]))
        error = forward + sample_grid(backward, forward + np.stack([x, y], axis=-1))
        return forward, np.exp(-np.linalg.norm(error, axis=-1) / TOLERANCE_PX).astype(np.float32)

    return checked


def methods(sequence: DavisSequence, flow: Path) -> dict[str, Propagation]:
    """Return ours (the output of `estimate_flow`), those of OpenCV, and zero motion."""
    size = sequence.mask(0).shape
    gray = [cv2.cvtColor(images.read_color(path), cv2.COLOR_RGB2GRAY) for path in sequence.pictures]
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    empty = np.zeros((*size, 2), np.float32)
    ours = stored_flow(flow, size)

    def dis(first: int, last: int) -> Dense:
        return search.calc(gray[first], gray[last], empty.copy())

    def farneback(first: int, last: int) -> Dense:
        return cv2.calcOpticalFlowFarneback(gray[first], gray[last], empty.copy(), *FARNEBACK)

    return {
        "ours": most_certain(ours),
        "ours, frame by frame": chained(lambda first, last: ours(first, last)[0]),
        "OpenCV DIS": chained(dis),
        "OpenCV DIS, our pairs and choice": most_certain(with_consistency(dis)),
        "OpenCV Farneback": chained(farneback),
        "no motion": lambda points, first, last: points,
    }


def evaluate(sequence: DavisSequence, folder: Path) -> dict[str, list[float]]:
    """Return the PCK of all methods at all thresholds on one sequence; cached."""
    done = folder / "pck.json"
    if not done.is_file():
        flow = davis.flow(davis.frames(sequence, folder / "frames"), folder / "flow")
        found = {}
        for name, propagate in methods(sequence, flow).items():
            error = errors(propagate, sequence)
            found[name] = [float((error < threshold).mean()) for threshold in THRESHOLDS]
        done.write_text(json.dumps(found) + "\n")
    found = json.loads(done.read_text())
    log(
        f"{sequence.name}: PCK@{THRESHOLDS} { ({name: np.round(value, 3).tolist() for name, value in found.items()}) }"
    )
    return found


def row(data: Path, out: Path) -> Row:
    """Evaluate on all sequences that have joints."""
    each = {
        name: evaluate(sequence, out / "davis" / name)
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
        " / ".join(f"PCK@{threshold}" for threshold in THRESHOLDS),
        cells.pop("ours"),
        cells,
        {},
        "above DIS and Farneback on every sequence",
        met,
        {"pck": each},
    )
