"""Simulated motion of one body in several homes as files: `body/`, `scenes/<number>.ply`, `motion.npz`.

`save` writes what a simulation of known truth produced; `load` reads it as `Lives`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.files import arrays, meshes
from pipeline.models.bodies import Body, load_body
from pipeline.models.longterm_examples import Lives
from pipeline.models.short_motions import Moving
from pipeline.models.surroundings import Surroundings
from pipeline.space.meshes import Mesh

Split = Literal["train", "held_out", "unseen"]
"""to learn from; another session in a known home; a home never seen"""


def save(
    folder: Path, body: Body, scenes: Sequence[Mesh], sessions: Sequence[Moving], scene_of: Sequence[int], split: Sequence[Split]
) -> None:
    """Write bodies, homes and sessions at 30 fps."""
    (folder / "body").mkdir()
    (folder / "scenes").mkdir()
    meshes.write_ply(folder / "body" / "agent.ply", body.mesh)
    arrays.save(
        folder / "body" / "skin.npz",
        weights=body.weights.astype(np.float32),
        agent_from_bone_rest=body.agent_from_bone_rest.astype(np.float32),
    )
    for number, mesh in enumerate(scenes):
        meshes.write_ply(folder / "scenes" / f"{number}.ply", mesh)
    arrays.save(
        folder / "motion.npz",
        frames=np.array([len(session) for session in sessions], np.int64),
        world_from_agent=np.concatenate([session.world_from_agent for session in sessions]).astype(np.float64),
        agent_from_bone=np.concatenate([session.agent_from_bone for session in sessions]).astype(np.float32),
        scene=np.asarray(scene_of, np.int64),
        split=np.array(split, np.str_),
    )


def load(folder: Path) -> tuple[Lives, list[Split]]:
    """Read what `save` wrote, and what each session is for. Raises InputError ART-010, ART-020 when damaged."""
    stored = arrays.load(folder / "motion.npz", ("frames", "world_from_agent", "agent_from_bone", "scene", "split"))
    ends = np.cumsum(stored["frames"])[:-1]
    parts = zip(np.split(stored["world_from_agent"], ends), np.split(stored["agent_from_bone"], ends), strict=True)
    roots = stored["world_from_agent"][:, :3, 3]
    count = int(stored["scene"].max()) + 1
    scenes = tuple(Surroundings.for_motion(meshes.read_ply(folder / "scenes" / f"{number}.ply"), roots) for number in range(count))
    lives = Lives(load_body(folder / "body"), tuple(Moving(*part) for part in parts), tuple(stored["scene"].tolist()), scenes)
    return lives, [str(each) for each in stored["split"]]
