"""Optical flow on joints of BADJA, carried from one annotated frame to the next, beside OpenCV's methods.

PCK@0.2: share of joints that land within 0.2 sqrt(area of the true mask) of where they are (Biggs et al. 2018).
Every method is chained frame by frame over the same pairs.
"""

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from benchmarks.real import davis
from benchmarks.real.davis import DavisSequence
from benchmarks.real.table import Row
from pipeline.core.progress import log
from pipeline.data import images, npz

Step = Callable[[int], Float[np.ndarray, "height width 2"]]
"""From a frame to its dense flow to the next frame, in pixels"""
PCK_SHARE = 0.2
FARNEBACK = (0.5, 5, 15, 3, 7, 1.5, 0)
"""Ratio of the pyramid, its levels, window, iterations, neighbourhood and smoothing of the polynomial, flags."""


def carried(
    step: Step, points: Float[np.ndarray, "point 2"], first: int, last: int
) -> Float[np.ndarray, "point 2"]:
    """Carry points (x, y) from frame to frame."""
    at = points.astype(np.float32)
    for frame in range(first, last):
        moved = cv2.remap(
            step(frame), at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        at = at + moved[0]
    return at


def hits(step: Step, sequence: DavisSequence) -> Bool[np.ndarray, "joint"]:
    """Return which joints that both frames of a pair show are carried to where they are."""
    joints, found = sequence.joints_by_frame(), []
    known = sorted(joints)
    for first, last in pairwise(known):
        both = joints[first].visible & joints[last].visible
        if both.any():
            there = carried(step, joints[first].position_px[both], first, last)
            error = np.linalg.norm(there - joints[last].position_px[both], axis=-1)
            found.append(error < PCK_SHARE * np.sqrt(sequence.mask(last).sum()))
    return np.concatenate(found) if found else np.zeros(0, bool)


def methods(sequence: DavisSequence, flow: Path) -> dict[str, Step]:
    """Return ours, as `estimate_flow` wrote it, OpenCV's, and none at all."""
    ours = npz.load(flow / "flow_1_fw.npz")["flow"]
    height, width = sequence.mask(0).shape
    gray = [cv2.cvtColor(images.read_color(path), cv2.COLOR_RGB2GRAY) for path in sequence.pictures]
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    empty = np.zeros((height, width, 2), np.float32)
    return {
        "ours": lambda frame: cv2.resize(ours[frame].astype(np.float32), (width, height)),
        "OpenCV DIS": lambda frame: dis.calc(gray[frame], gray[frame + 1], empty.copy()),
        "OpenCV Farneback": lambda frame: cv2.calcOpticalFlowFarneback(
            gray[frame], gray[frame + 1], empty.copy(), *FARNEBACK
        ),
        "no motion": lambda frame: empty,
    }


def measured(sequence: DavisSequence, folder: Path) -> dict[str, float]:
    """Return the PCK of all methods on one sequence."""
    done = folder / "pck.json"
    if not done.is_file():
        flow = davis.flow(davis.frames(sequence, folder / "frames"), folder / "flow")
        found = {name: float(hits(step, sequence).mean()) for name, step in methods(sequence, flow).items()}
        done.write_text(json.dumps(found) + "\n")
    found = json.loads(done.read_text())
    log(f"{sequence.name}: PCK@{PCK_SHARE} { ({name: round(value, 3) for name, value in found.items()}) }")
    return found


def row(data: Path, out: Path) -> Row:
    """Measure all sequences that have joints."""
    each = {
        name: measured(sequence, out / "davis" / name)
        for name, sequence in davis.animals(data).items()
        if sequence.joints is not None
    }
    names = list(next(iter(each.values())))
    cells = {name: ", ".join(f"{values[name]:.3f}" for values in each.values()) for name in names}
    rivals = [name for name in names if name.startswith("OpenCV")]
    met = all(values["ours"] > values[rival] for values in each.values() for rival in rivals)
    return Row(
        "flow",
        f"DAVIS with BADJA joints: {', '.join(each)}",
        f"PCK@{PCK_SHARE}",
        cells.pop("ours"),
        cells,
        {},
        "above DIS and Farneback on every sequence",
        met,
        {"pck": each},
    )
