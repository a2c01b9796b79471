"""Masks of DAVIS animals from the box of the first mask, without weights and depth."""

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
BAR_MEAN, BAR_WORST = 0.75, 0.60
"""mean and lowest IoU of the sequences that nothing was designed on"""
DESIGNED_ON = frozenset(
    "bear blackswan dog dog-agility elephant flamingo horsejump-low mallard-fly mallard-water rhino".split()
)
"""sequences that the method was designed on"""


def segmented(sequence: DavisSequence, folder: Path) -> float:
    """Run `estimate_flow` and `segment_agent` with one box, and return the mean IoU over all frames."""
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
    """Measure all sequences of animals."""
    each = {name: segmented(sequence, out / "davis" / name) for name, sequence in davis.animals(data).items()}
    others = [value for name, value in each.items() if name not in DESIGNED_ON]
    met = bool(others) and np.mean(others) >= BAR_MEAN and min(others) >= BAR_WORST
    listed = ", ".join(f"{name} {value:.2f}" for name, value in each.items())
    mean = f"{np.mean(others):.2f} over the {len(others)} others" if others else "no others"
    return Row(
        "masks",
        f"DAVIS 2016 animals, {len(each)} sequences, one box, no weights",
        "mean IoU",
        f"{mean}; {listed}",
        {},
        {},
        f"mean >= {BAR_MEAN:.2f} over the others, which nothing was designed on, none below {BAR_WORST:.2f}",
        bool(met),
        {"iou": each},
    )
