"""Open what the stage reads: recordings, and the reconstruction as meshes and motion."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from pipeline.files import arrays, meshes
from pipeline.files.clips import Clip, Masks
from pipeline.models import fields, gaussians, motion
from pipeline.models.gaussians import Splats
from stages.refine_gaussians import cover
from stages.refine_gaussians.cover import Cover
from stages.refine_gaussians.refine import Sequence4D
from stages.refine_gaussians.views import Recording


@dataclass(frozen=True)
class Counts:
    """How many Gaussians there are."""

    scene: int = 100_000
    """of the scene"""
    agent: int = 5_000
    """of the agent"""


def read_sequences(
    reconstruction: Path, frames: Mapping[str, Path], masks: Mapping[str, Path], flow: Mapping[str, Path]
) -> list[Sequence4D]:
    """Read all videos with their motion, sessions and templates, in id order on one frame axis."""
    sequences, first, video = [], 0, 0
    for id in sorted(frames):
        session, template = reconstruction / id / "motion.npz", reconstruction / "templates" / f"{id}.npz"
        if not (session.exists() or template.exists()):
            continue
        found = motion.load(session if session.exists() else template)
        is_turnaround = not session.exists() and np.isfinite(found.world_from_agent).all((1, 2)).any()
        sequences.append(Sequence4D(_recording(id, frames, masks, flow), found, first, None if is_turnaround else video))
        first += len(found.timestamp_s)
        video += not is_turnaround
    return sequences


def _recording(id: str, frames: Mapping[str, Path], masks: Mapping[str, Path], flow: Mapping[str, Path]) -> Recording:
    path = flow[id] / "flow_1_fw.npz" if id in flow else None
    lazily = [arrays.open_lazily(path, name) if path else None for name in ("flow", "confidence")]
    return Recording(id, Clip.open(frames[id]), Masks.open(masks[id]) if id in masks else None, *lazily)


def read_splats(
    reconstruction: Path, counts: Counts, sequences: Sequence[Sequence4D], looking: Cover, rng: np.random.Generator, device: str
) -> Splats:
    """Cover the reconstruction's surfaces with Gaussians; the agent's take their skinning weights from its body."""
    found = fields.load(reconstruction)
    codes = [found.video_code(sequence.recording.id) for sequence in sequences if sequence.video is not None]
    scene = cover.scene(found.scene, codes, counts.scene, sequences, looking, rng)
    agent = gaussians.from_mesh(meshes.read_ply(reconstruction / "agent.ply"), counts.agent, rng)
    with torch.no_grad():
        weights = found.body.weights(agent.means)
    splats = Splats(scene.gaussians, agent, weights, found.body.agent_from_bone_rest, len(codes), torch.from_numpy(scene.stands))
    splats.appearance.data.copy_(torch.from_numpy(scene.appearance))
    return splats.to(device)
