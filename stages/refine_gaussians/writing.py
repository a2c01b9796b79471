"""Write refined Gaussians and motion as the artifact `splats`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from pipeline.data import gaussian_ply, motion
from pipeline.fields import gaussians
from pipeline.fields.gaussians import Splats
from stages.refine_gaussians.refine import MotionDeltas, Sequence4D, refined


def write(folder: Path, splats: Splats, deltas: MotionDeltas, sequences: Sequence[Sequence4D]) -> None:
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
        videos=np.array([sequence.recording.id for sequence in sequences if sequence.video is not None]),
        stands=torch.cat([splats.stands[:-1, shared], splats.stands[:-1, moved]], dim=1).cpu().numpy(),
        appearance=splats.appearance.detach().cpu().numpy(),
    )
    for sequence in sequences:
        if sequence.video is not None and sequence.recording.masks is not None:
            (folder / sequence.recording.id).mkdir()
            motion.save(
                folder / sequence.recording.id / "motion.npz",
                refined(sequence.motion, deltas, sequence.first),
            )
