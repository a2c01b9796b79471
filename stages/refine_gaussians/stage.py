"""The stage: a reconstruction and its recordings -> refined 3D Gaussians and motion."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch

from pipeline.core import devices, distributed
from pipeline.data import gaussian_ply, motion
from pipeline.fields import gaussians
from pipeline.fields.gaussians import Splats
from stages.refine_gaussians import cover, pictures, refine
from stages.refine_gaussians.config import Config
from stages.refine_gaussians.views import DrawnVideo, read_videos


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
    """Refine one reconstruction into `out`; the first process writes."""
    backend = config.backend
    if backend == "auto":
        backend = "gsplat" if device == "cuda" and find_spec("gsplat") else "tiles"
    if backend == "tiles":
        device = "cpu"  # the rasterizer is compiled for CPUs
    distributed.join(device)
    videos = read_videos(inputs.reconstruction, inputs.frames, inputs.masks, inputs.flow)
    rng = np.random.default_rng(config.seed)
    splats = cover.splats(inputs.reconstruction, config.counts, videos, config.cover_frames, rng).to(device)
    total = sum(len(video.motion.timestamp_s) for video in videos)
    deltas = refine.MotionDeltas(total, len(splats.agent_from_bone_rest)).to(device)
    loss = refine.FrameLoss(splats, deltas, videos, config.weights, config.long_side_px, backend)
    record = refine.refine(loss, config.steps, config.seed, resume, config.save_every)
    if not distributed.leave():
        return
    write(out, splats, deltas, videos)
    pictures.report_quality(out, loss, videos, record)


def write(folder: Path, splats: Splats, deltas: refine.MotionDeltas, videos: Sequence[DrawnVideo]) -> None:
    """Write all clouds, the agent's weights, the videos' layouts and exposures, and each session's motion."""
    scene, agent = gaussians.drawable(splats.scene), gaussians.drawable(splats.agent)
    shared, moved = scene & splats.stands[-1], scene & ~splats.stands[-1]
    gaussians.save_ply(folder / "scene.ply", splats.scene, shared)
    gaussians.save_ply(folder / "moved.ply", splats.scene, moved)
    gaussians.save_ply(folder / "agent.ply", splats.agent, agent)
    gaussian_ply.SPLATS.save(
        folder / "splats.npz",
        agent_weights=splats.agent_weights[agent].cpu().numpy(),
        agent_from_bone_rest=splats.agent_from_bone_rest.cpu().numpy(),
        videos=np.array([video.id for video in videos if video.appearance is not None]),
        stands=torch.cat([splats.stands[:-1, shared], splats.stands[:-1, moved]], dim=1).cpu().numpy(),
        appearance=splats.appearance.detach().cpu().numpy(),
    )
    for video in videos:
        if video.appearance is not None and video.masks is not None:
            (folder / video.id).mkdir()
            motion.save(folder / video.id / "motion.npz", refine.corrected(video.motion, deltas, video.first))
