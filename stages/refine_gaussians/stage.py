"""The stage: a reconstruction and its recordings -> refined 3D Gaussians and motion."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core import devices, distributed
from stages.refine_gaussians import pictures, reading, refine, writing
from stages.refine_gaussians.config import Config


@dataclass(frozen=True)
class Inputs:
    """What the stage reads; per-recording folders by id."""

    reconstruction: Path
    frames: Mapping[str, Path]
    """of walk-through, turnaround and sessions"""
    masks: Mapping[str, Path]
    flow: Mapping[str, Path]


def run(
    inputs: Inputs, config: Config, out: Path, *, device: devices.Device = "cpu", resume: Path | None = None
) -> None:
    """Refine one reconstruction into `out`; of several processes the first writes."""
    distributed.join(device)
    backend = config.backend
    if backend == "auto":
        backend = "gsplat" if device == "cuda" else "tiles"
    sequences = reading.read_sequences(inputs.reconstruction, inputs.frames, inputs.masks, inputs.flow)
    rng = np.random.default_rng(config.seed)
    splats = reading.read_splats(
        inputs.reconstruction, config.counts, sequences, config.cover_frames, rng, device
    )
    total = sum(len(sequence.motion.timestamp_s) for sequence in sequences)
    deltas = refine.MotionDeltas(total, len(splats.agent_from_bone_rest)).to(device)
    loss = refine.FrameLoss(splats, deltas, sequences, config.weights, config.long_side_px, backend)
    record = refine.refine(loss, config.steps, config.seed, resume, config.save_every)
    if not distributed.leave():
        return
    writing.write(out, splats, deltas, sequences)
    pictures.report_quality(out, loss, sequences, record)
