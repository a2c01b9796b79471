"""Masks of DAVIS animals from the bounding box of the first mask, without pretrained weights and depth, next to
GrabCut in a box that our flow moves from frame to frame."""

import json
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from benchmarks.behavior_builds import emptied
from benchmarks.real import davis
from benchmarks.real.davis import DavisSequence
from benchmarks.real.table import Row
from pipeline.core.progress import log
from pipeline.data import flow
from pipeline.data.clips import Clip, Masks
from stages.segment_agent import stage
from stages.segment_agent.config import Config

AGENT = 255
GRABCUT_ITERATIONS, GRABCUT_REDUCED = 3, 2
"""iterations, and the factor by which pictures are reduced"""
BOX_MARGIN = 0.1
"""by which the box of a mask is enlarged for the next frame, share of its sides"""
PEER = "GrabCut in a box moved by our flow"
MIN_MEAN_IOU, MIN_WORST_IOU = 0.75, 0.60
"""targets of the mean and the lowest IoU on held-out sequences"""
DEVELOPMENT = frozenset(
    "bear blackswan dog dog-agility elephant flamingo horsejump-low mallard-fly mallard-water rhino".split()
)
"""sequences used in the development of the method"""


def box_of(mask: Bool[np.ndarray, "height width"]) -> list[int]:
    """Return the bounding box (x0, y0, x1, y1) of a mask that is not empty, pixels."""
    rows, columns = np.nonzero(mask)
    return [int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1]


def mean_iou(sequence: DavisSequence, folder: Path) -> float:
    """Run `estimate_flow` and `segment_agent` with a box prompt; return the mean IoU over all frames; cached."""
    done = folder / "iou.json"
    if not done.is_file():
        frames = davis.frames(sequence, folder / "frames")
        flows = davis.flow(frames, folder / "flow")
        prompt, out = folder / "box.prompt.toml", emptied(folder / "masks")
        prompt.write_text(f"frame = 0\nbox = {box_of(sequence.mask(0))}\n")
        stage.run(stage.Inputs(frames, flows, prompt), Config(), out)
        found = Masks.open(out)
        each = [iou(found[frame] == AGENT, sequence.mask(frame)) for frame in range(len(sequence.masks))]
        done.write_text(json.dumps(each) + "\n")
    each = json.loads(done.read_text())
    log(f"{sequence.name}: mean IoU {np.mean(each):.3f}, worst frame {np.min(each):.3f}")
    return float(np.mean(each))


def peer_iou(sequence: DavisSequence, folder: Path) -> float:
    """Run the peer from the same box on the same frames and flow; return the mean IoU over all frames; cached."""
    done = folder / "peer_iou.json"
    if not done.is_file():
        frames = davis.frames(sequence, folder / "frames")
        found = grabcut_masks(
            Clip.open(frames), davis.flow(frames, folder / "flow"), box_of(sequence.mask(0))
        )
        each = [iou(mask, sequence.mask(frame)) for frame, mask in enumerate(found)]
        done.write_text(json.dumps(each) + "\n")
    each = json.loads(done.read_text())
    log(f"{sequence.name}: {PEER}, mean IoU {np.mean(each):.3f}")
    return float(np.mean(each))


def grabcut_masks(clip: Clip, flows: Path, box: list[int]) -> list[Bool[np.ndarray, "height width"]]:
    """Return masks of all frames by GrabCut in a box (x0, y0, x1, y1, pixels), that of the first frame. In the others it
    is that of the last mask warped along our flow, enlarged by a margin; it stays where the mask is empty.
    """
    step, masks = flow.open_flow(flows, 1), []
    height, width = clip.color_size
    cv2.setRNGSeed(0)
    for frame in range(len(clip)):
        if masks and masks[-1].any():
            rows, columns = np.nonzero(masks[-1])
            moved = np.asarray(step[frame - 1], float)
            cells = (
                np.minimum(rows // flow.STRIDE_PX, moved.shape[0] - 1),
                np.minimum(columns // flow.STRIDE_PX, moved.shape[1] - 1),
            )
            ends = np.stack([columns, rows], axis=1) + 0.5 + moved[cells]
            low, high = np.percentile(ends, [1, 99], axis=0)  # without pixels whose flow is wrong
            margin = BOX_MARGIN * (high - low)
            corners = np.clip([low - margin, high + margin], 0, [width, height])
            box = corners.round().astype(int).ravel().tolist()
        masks.append(grabcut(clip.color(frame), box))
    return masks


def grabcut(color: np.ndarray, box: list[int]) -> Bool[np.ndarray, "height width"]:
    """Return the foreground of an RGB picture in a box (x0, y0, x1, y1, pixels) by GrabCut; else it is background."""
    height, width = color.shape[:2]
    size = (width // GRABCUT_REDUCED, height // GRABCUT_REDUCED)
    small = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    x0, y0, x1, y1 = np.array(box) // GRABCUT_REDUCED
    labels = np.full(small.shape[:2], cv2.GC_BGD, np.uint8)
    labels[y0:y1, x0:x1] = cv2.GC_PR_FGD
    if len(np.unique(labels)) == 2:
        models = np.zeros((2, 1, 65))
        cv2.grabCut(
            small, labels, (0, 0, 0, 0), models[0], models[1], GRABCUT_ITERATIONS, cv2.GC_INIT_WITH_MASK
        )
    found = cv2.resize(labels, (width, height), interpolation=cv2.INTER_NEAREST)
    return (found == cv2.GC_FGD) | (found == cv2.GC_PR_FGD)


def iou(found: np.ndarray, true: np.ndarray) -> float:
    """Return intersection over union; 1 where both are empty."""
    union = (found | true).sum()
    return float((found & true).sum() / union) if union else 1.0


def row(data: Path, out: Path) -> Row:
    """Evaluate on all animal sequences."""
    each, peers = {}, {}
    for name, sequence in davis.animals(data).items():
        each[name] = mean_iou(sequence, out / "davis" / name)
        peers[name] = peer_iou(sequence, out / "davis" / name)
    held_out = [value for name, value in each.items() if name not in DEVELOPMENT]
    met = bool(held_out) and np.mean(held_out) >= MIN_MEAN_IOU and min(held_out) >= MIN_WORST_IOU
    return Row(
        "masks",
        f"DAVIS 2016 animals, {len(each)} sequences, one box, no weights",
        "mean IoU",
        listed(each),
        {PEER: listed(peers)},
        {},
        f"mean over held-out sequences >= {MIN_MEAN_IOU:.2f}, minimum >= {MIN_WORST_IOU:.2f}",
        bool(met),
        {"iou": each, "peer_iou": peers},
    )


def listed(each: dict[str, float]) -> str:
    """Return the mean over held-out sequences, and all values by sequence."""
    held_out = [value for name, value in each.items() if name not in DEVELOPMENT]
    mean = "no held-out sequences"
    if held_out:
        mean = f"{np.mean(held_out):.2f} over {len(held_out)} held-out sequences"
    return f"{mean}; {', '.join(f'{name} {value:.2f}' for name, value in each.items())}"
