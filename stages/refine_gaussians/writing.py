"""Write refined Gaussians and motion as the artifact `splats`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from pipeline.files import arrays
from pipeline.models import gaussians, motion
from pipeline.models.gaussians import Splats
from stages.refine_gaussians.refine import MotionDeltas, Sequence4D, refined


def write(folder: Path, splats: Splats, deltas: MotionDeltas, sequences: Sequence[Sequence4D]) -> None:
    """Write all clouds, the agent's weights, the videos' layouts and exposures, and each session's motion."""
    kept, agent = gaussians.kept(splats.scene), gaussians.kept(splats.agent)
    shared, moved = kept & splats.stands[-1], kept & ~splats.stands[-1]
    gaussians.save_ply(folder / "scene.ply", splats.scene, shared)
    gaussians.save_ply(folder / "moved.ply", splats.scene, moved)
    gaussians.save_ply(folder / "agent.ply", splats.agent, agent)
    arrays.save(
        folder / "splats.npz",
        agent_weights=splats.agent_weights[agent].cpu().numpy().astype(np.float32),
        agent_from_bone_rest=splats.agent_from_bone_rest.cpu().numpy().astype(np.float32),
        videos=np.array([sequence.recording.id for sequence in sequences if sequence.video is not None]),
        stands=torch.cat([splats.stands[:-1, shared], splats.stands[:-1, moved]], dim=1).cpu().numpy(),
        appearance=splats.appearance.detach().cpu().numpy().astype(np.float32),
    )
    for sequence in sequences:
        if sequence.video is not None and sequence.recording.masks is not None:
            (folder / sequence.recording.id).mkdir()
            motion.save(folder / sequence.recording.id / "motion.npz", refined(sequence.motion, deltas, sequence.first))
