"""Open what the stage reads: recordings, and the reconstruction as meshes and motion."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from pipeline.data import motion, ply
from pipeline.data.clips import Clip, Masks
from pipeline.data.flow import open_confidence, open_flow
from pipeline.fields import fields, gaussians
from pipeline.fields.gaussians import Splats
from stages.refine_gaussians import cover
from stages.refine_gaussians.config import GaussianCounts
from stages.refine_gaussians.refine import Sequence4D
from stages.refine_gaussians.views import DrawnRecording


def read_sequences(
    reconstruction: Path, frames: Mapping[str, Path], masks: Mapping[str, Path], flow: Mapping[str, Path]
) -> list[Sequence4D]:
    """Read all videos with their motion, sessions and templates, in id order on one frame axis."""
    sequences, first, video = [], 0, 0
    for id in sorted(frames):
        session, template = reconstruction / id / "motion.npz", reconstruction / "templates" / f"{id}.npz"
        if not (session.exists() or template.exists()):
            continue
        loaded = motion.load(session if session.exists() else template)
        is_turnaround = not session.exists() and np.isfinite(loaded.world_from_agent).all((1, 2)).any()
        sequences.append(
            Sequence4D(_recording(id, frames, masks, flow), loaded, first, None if is_turnaround else video)
        )
        first += len(loaded.timestamp_s)
        video += not is_turnaround
    return sequences


def _recording(
    id: str, frames: Mapping[str, Path], masks: Mapping[str, Path], flow: Mapping[str, Path]
) -> DrawnRecording:
    tables = (open_flow(flow[id], 1), open_confidence(flow[id], 1)) if id in flow else None
    labels = Masks.open(masks[id]) if id in masks else None
    return DrawnRecording(id, Clip.open(frames[id]), labels, tables)


def read_splats(
    reconstruction: Path,
    counts: GaussianCounts,
    sequences: Sequence[Sequence4D],
    frames: int,
    rng: np.random.Generator,
    device: str,
) -> Splats:
    """Cover the reconstruction's surfaces with Gaussians; the agent's take their skinning weights from its
    body.
    """
    loaded = fields.load(reconstruction)
    codes = [loaded.video_code(sequence.recording.id) for sequence in sequences if sequence.video is not None]
    scene = cover.scene(loaded.scene, codes, counts.scene, sequences, frames, rng)
    agent = gaussians.from_mesh(ply.read_ply(reconstruction / "agent.ply"), counts.agent, rng)
    with torch.no_grad():
        weights = loaded.body.weights(agent.means)
    splats = Splats(
        scene.gaussians,
        agent,
        weights,
        loaded.body.agent_from_bone_rest,
        len(codes),
        torch.from_numpy(scene.stands),
    )
    splats.appearance.data.copy_(torch.from_numpy(scene.appearance))
    return splats.to(device)
