"""Register one session to the scene and the animal's roots to the world.

Frames are localised and vote for one motion of the whole recording; odometry, votes, depth and pictures
then align all frames at once; the animal is placed in every frame that shows it. Writes poses.npz and
status.json; a recording that does not fit has no poses.npz, and status.json says why.
"""

import json
from dataclasses import dataclass

import numpy as np

from pipeline import cli, qa
from pipeline.files import arrays, meshes
from pipeline.files.clips import Clip, Masks
from pipeline.models import localizer
from stages.register_videos import pictures, registration
from stages.register_videos.registration import Maps, Registered


@dataclass(frozen=True)
class Config(registration.Options):
    """How a recording is registered."""

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
    walk = arrays.load(task.input("scene_template") / "cameras.npz", ("timestamp_s", "world_from_camera"))
    found = registration.register(clip, masks, maps, task.config, np.random.default_rng(task.config.seed))
    with task.create() as folder:
        if isinstance(found, Registered):
            arrays.save(folder / "poses.npz", timestamp_s=clip.timestamp_s, **found.tables())
        (folder / "status.json").write_text(
            json.dumps(pictures.status(found, walk["timestamp_s"], walk["world_from_camera"]), indent=1) + "\n"
        )
        qa.write(
            folder, good="template edges lie on the frames' edges, the animal's outline fits, paths stay in free space",
            bad="edges are shifted, paths cross walls, the animal faces backwards",
            checks=pictures.checks(found), pictures=pictures.pictures(found, clip, maps),
        )  # fmt: skip


if __name__ == "__main__":
    cli.enter(
        __doc__,
        run,
        config=Config,
        reads=("frames", "masks", "scene_template", "agent_template", "scene_localizer", "agent_localizer"),
    )
