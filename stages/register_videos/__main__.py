"""Register one session to the scene and the animal's roots to the world.

Frames are localised and vote for one motion of the whole recording; odometry, votes, depth and pictures
then align all frames at once; the animal is placed in every frame that shows it. Writes poses.npz and
status.json; a recording that does not fit has no poses.npz, and status.json says why.
"""

import json
from dataclasses import dataclass, field

import numpy as np

from pipeline import cli, qa
from pipeline.files import arrays, meshes
from pipeline.files.clips import Clip, Masks
from pipeline.models import localizer
from stages.register_videos import pictures, registration
from stages.register_videos.agent_roots import RootOptions
from stages.register_videos.alignment import AlignOptions
from stages.register_videos.registration import GateOptions, Maps, Registered
from stages.register_videos.votes import VoteOptions


@dataclass(frozen=True)
class Config:
    """How a recording is registered."""

    vote: VoteOptions = field(default_factory=VoteOptions)
    """Which frames vote, and when votes agree."""
    align: AlignOptions = field(default_factory=AlignOptions)
    """Weights, reach and rounds of the alignment."""
    gate: GateOptions = field(default_factory=GateOptions)
    """When a recording is believed, and its confidence."""
    root: RootOptions = field(default_factory=RootOptions)
    """How the animal is placed."""
    seed: int = 0
    """Seed of thinning and calibration."""


def run(task: cli.Task) -> None:
    """Register and write."""
    clip, masks = Clip.open(task.input("frames")), Masks.open(task.input("masks"))
    maps = Maps(
        scene=meshes.read_ply(task.input("scene_template") / "mesh.ply"),
        agent=meshes.read_ply(task.input("agent_template") / "agent.ply"),
        scene_localizer=localizer.load(task.input("scene_localizer")),
        agent_localizer=localizer.load(task.input("agent_localizer")),
    )
    config = task.config
    found = registration.register(
        clip, masks, maps, vote=config.vote, align=config.align, gate=config.gate, root=config.root, rng=np.random.default_rng(config.seed)
    )
    with task.create() as folder:
        if isinstance(found, Registered):
            arrays.save(
                folder / "poses.npz", timestamp_s=clip.timestamp_s, world_from_camera=found.aligned.world_from_camera,
                world_from_agent=found.roots.world_from_agent, confidence=found.confidence.astype(np.float32),
                agent_confidence=found.agent_confidence.astype(np.float32), agent_visible=found.roots.visible,
            )  # fmt: skip
        (folder / "status.json").write_text(json.dumps(pictures.status(found), indent=1) + "\n")
        qa.write(
            folder, good="template edges lie on the frames' edges, the animal's outline fits, paths stay in free space",
            bad="edges are shifted, paths cross walls, the animal faces backwards",
            checks=pictures.checks(found), pictures=pictures.pictures(found, clip, maps),
        )  # fmt: skip


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("frames", "masks", "scene_template", "agent_template", "scene_localizer", "agent_localizer"), optional=("features",))
