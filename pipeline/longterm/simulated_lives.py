"""Files of simulated motion of one body in several homes: `body/`, `scenes/<number>.ply`, `motion.npz`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.data import npz, ply
from pipeline.geometry.meshes import Mesh
from pipeline.longterm.bodies import SkinnedBody, load_body
from pipeline.longterm.examples import DatasetSplit, MotionDataset
from pipeline.longterm.short_motions import BodyMotion
from pipeline.longterm.surroundings import MotionScene

Split = Literal["train", "held_out", "unseen"]
"""training sessions; held-out sessions in training homes; sessions in an unseen home"""


def save(
    folder: Path,
    body: SkinnedBody,
    scenes: Sequence[Mesh],
    sessions: Sequence[BodyMotion],
    scene_of: Sequence[int],
    split: Sequence[Split],
) -> None:
    """Write the body, the homes and the sessions at 30 fps."""
    (folder / "body").mkdir()
    (folder / "scenes").mkdir()
    ply.write_ply(folder / "body" / "agent.ply", body.mesh)
    npz.save(
        folder / "body" / "skin.npz",
        weights=body.weights.astype(np.float32),
        agent_from_bone_rest=body.agent_from_bone_rest.astype(np.float32),
    )
    for number, mesh in enumerate(scenes):
        ply.write_ply(folder / "scenes" / f"{number}.ply", mesh)
    npz.save(
        folder / "motion.npz",
        frames=np.array([len(session) for session in sessions], np.int64),
        world_from_agent=np.concatenate([session.world_from_agent for session in sessions], dtype=np.float64),
        agent_from_bone=np.concatenate([session.agent_from_bone for session in sessions]).astype(np.float32),
        scene=np.asarray(scene_of, np.int64),
        split=np.array(split, np.str_),
    )


def load(folder: Path) -> DatasetSplit:
    """Read what `save` wrote. Raises InputError ART-010, ART-020 when damaged."""
    names = ("frames", "world_from_agent", "agent_from_bone", "scene", "split")
    stored = npz.load(folder / "motion.npz", names)
    ends = np.cumsum(stored["frames"])[:-1]
    roots_and_bones = (np.split(stored[name], ends) for name in ("world_from_agent", "agent_from_bone"))
    sessions = tuple(BodyMotion(*part) for part in zip(*roots_and_bones, strict=True))
    roots = stored["world_from_agent"][:, :3, 3]
    count = int(stored["scene"].max()) + 1
    scenes = tuple(
        MotionScene.for_motion(ply.read_ply(folder / "scenes" / f"{number}.ply"), roots)
        for number in range(count)
    )
    dataset = MotionDataset(load_body(folder / "body"), sessions, tuple(stored["scene"].tolist()), scenes)
    return DatasetSplit.of(dataset, stored["split"].tolist())
