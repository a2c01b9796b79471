"""Masks of DAVIS animals from the bounding box of the first mask, without pretrained weights and depth."""

import json
import shutil
from pathlib import Path

import numpy as np

from benchmarks.real import davis
from benchmarks.real.davis import DavisSequence
from benchmarks.real.table import Row
from pipeline.core.progress import log
from pipeline.data.clips import Masks
from stages.segment_agent import stage
from stages.segment_agent.config import Config

AGENT = 255
MIN_MEAN_IOU, MIN_WORST_IOU = 0.75, 0.60
"""targets of the mean and the lowest IoU on held-out sequences"""
DEVELOPMENT = frozenset(
    "bear blackswan dog dog-agility elephant flamingo horsejump-low mallard-fly mallard-water rhino".split()
)
"""sequences used in the development of the method"""


def mean_iou(sequence: DavisSequence, folder: Path) -> float:
    """Run `estimate_flow` and `segment_agent` with a box prompt; return the mean IoU over all frames; cached."""
    done = folder / "iou.json"
    if not done.is_file():
        frames = davis.frames(sequence, folder / "frames")
        flow = davis.flow(frames, folder / "flow")
        rows, columns = np.nonzero(sequence.mask(0))
        box = [int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1]
        prompt, out = folder / "box.prompt.toml", folder / "masks"
        prompt.write_text(f"frame = 0\nbox = {box}\n")
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        stage.run(stage.Inputs(frames, flow, prompt), Config(), out)
        found = Masks.open(out)
        each = [iou(found[frame] == AGENT, sequence.mask(frame)) for frame in range(len(sequence.masks))]
        done.write_text(json.dumps(each) + "\n")
    each = json.loads(done.read_text())
    log(f"{sequence.name}: mean IoU {np.mean(each):.3f}, worst frame {np.min(each):.3f}")
    return float(np.mean(each))


def iou(found: np.ndarray, true: np.ndarray) -> float:
    """Return intersection over union; 1 where both are empty."""
    union = (found | true).sum()
    return float((found & true).sum() / union) if union else 1.0


def row(data: Path, out: Path) -> Row:
    """Evaluate on all animal sequences."""
    each = {name: mean_iou(sequence, out / "davis" / name) for name, sequence in davis.animals(data).items()}
    held_out = [value for name, value in each.items() if name not in DEVELOPMENT]
    met = bool(held_out) and np.mean(held_out) >= MIN_MEAN_IOU and min(held_out) >= MIN_WORST_IOU
    listed = ", ".join(f"{name} {value:.2f}" for name, value in each.items())
    mean = (
        f"{np.mean(held_out):.2f} over {len(held_out)} held-out sequences"
        if held_out
        else "no held-out sequences"
    )
    return Row(
        "masks",
        f"DAVIS 2016 animals, {len(each)} sequences, one box, no weights",
        "mean IoU",
        f"{mean}; {listed}",
        {},
        {},
        f"mean over held-out sequences >= {MIN_MEAN_IOU:.2f}, minimum >= {MIN_WORST_IOU:.2f}",
        bool(met),
        {"iou": each},
    )
