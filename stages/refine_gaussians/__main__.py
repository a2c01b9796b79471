"""Replace the reconstruction's fields by 3D Gaussians and refine them against the pictures.

Gaussians cover the extracted surfaces of scene and agent; they, each video's exposure and, slightly, the agent's
motion are optimised by colour, depth, silhouette and flow. Writes standard 3D Gaussian PLY files.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline import cli
from stages.refine_gaussians import pictures, reading, refine, writing
from stages.refine_gaussians.cover import Cover
from stages.refine_gaussians.reading import Counts
from stages.refine_gaussians.refine import Rates, Weights


@dataclass(frozen=True)
class Config:
    """Settings of the Gaussian refinement."""

    seed: int = 0
    """of all randomness"""
    steps: int = 1000
    """frames drawn, one a step"""
    counts: Counts = Counts()
    """numbers of Gaussians"""
    cover: Cover = Cover()
    """how the room is covered at the beginning"""
    long_side_px: int = 192
    """longer side of drawn pictures, pixels"""
    weights: Weights = Weights()
    """of the losses"""
    rates: Rates = Rates()
    """of learning"""
    save_every: int = 200
    """steps between checkpoints"""
    backend: Literal["auto", "tiles", "gsplat"] = "auto"
    """rasteriser; auto: gsplat on CUDA, tiles otherwise"""


def run(task: cli.Task) -> None:
    """Refine one reconstruction."""
    config: Config = task.config
    backend = {"cpu": "tiles", "cuda": "gsplat"}[task.device] if config.backend == "auto" else config.backend
    folder_4d = task.input("reconstruction")
    frames = task.per_video("frames", ("walkthrough", "turnaround", "session"))
    sequences = reading.read_sequences(folder_4d, frames, task.per_video("masks"), task.per_video("flow"))
    splats = reading.read_splats(folder_4d, config.counts, sequences, config.cover, np.random.default_rng(config.seed), task.device)
    total = sum(len(sequence.motion.timestamp_s) for sequence in sequences)
    deltas = refine.MotionDeltas(total, len(splats.agent_from_bone_rest)).to(task.device)
    loss = refine.FrameLoss(splats, deltas, sequences, config.weights, config.long_side_px, backend)
    record = refine.refine(loss, config.rates, config.steps, config.seed, task.resume, config.save_every)
    with task.create() as folder:
        writing.write(folder, splats, deltas, sequences)
        pictures.report_quality(folder, loss, sequences, record)


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("reconstruction", "frames", "masks", "flow"))
