"""Sessions of the built-in animal as motion at 30 fps, in homes as surfaces."""

from dataclasses import dataclass

import numpy as np

from pipeline.data.qa import Check
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from pipeline.longterm.bodies import SkinnedBody
from pipeline.longterm.short_motions import RATE_HZ, STEPS, BodyMotion
from pipeline.longterm.simulated_lives import Split
from stages.synthesize_capture import dwellings, gait, session, sheets
from stages.synthesize_capture.animal import BONES, HEADS, Animal
from stages.synthesize_capture.room import DEPTH_M, HEIGHT_M, WIDTH_M, Room
from stages.synthesize_capture.sheets import Sheet


@dataclass(frozen=True)
class Lived:
    """All sessions, one home's surface for each."""

    scenes: list[Mesh]
    sessions: list[BodyMotion]
    scene_of: list[int]
    split: list[Split]


def lived(homes: int, sessions_per_home: int, session_s: float, seed: int) -> Lived:
    """Let the animal live in every home for some sessions."""
    made = Lived([], [], [], [])
    for home in range(homes):
        dwelling = dwellings.furnish_otherwise(np.random.default_rng([seed, 20, home]))
        for number in range(sessions_per_home):
            rng = np.random.default_rng([seed, 21, home, number])
            arranged = dwelling.rearranged(rng)
            lived_session = session.simulate_session(arranged.room, rng, session_s)
            motion = gait.poses(lived_session.animal, np.arange(round(session_s * RATE_HZ)) / RATE_HZ)
            made.scenes.append(surface_of(arranged.room))
            made.sessions.append(BodyMotion(motion.world_from_agent, motion.agent_from_bone))
            made.scene_of.append(len(made.scenes) - 1)
            last = number == sessions_per_home - 1 and sessions_per_home > 1
            made.split.append(
                "unseen" if home == homes - 1 and homes > 1 else "held_out" if last else "train"
            )
    return made


def body_of(creature: Animal) -> SkinnedBody:
    """Return the animal as a skinned body."""
    weights = np.zeros((len(creature.vertices), len(BONES)))
    np.put_along_axis(weights, creature.bone, creature.weight, axis=1)
    return SkinnedBody(
        Mesh(creature.vertices, creature.faces), weights, rigid.make(np.eye(3)[None], HEADS), np.zeros(0)
    )


def surface_of(room: Room) -> Mesh:
    """Return floor, walls and all furniture as one surface that faces the free space."""
    vertices, faces, _, _ = sheets.triangles([*_shell(), *room.sheets()])
    return Mesh(vertices, faces)


def checks(made: Lived) -> list[Check]:
    """Judge the sessions."""
    roots = [each.world_from_agent[:, :3, 3] for each in made.sessions]
    way = np.concatenate([np.linalg.norm(root[STEPS:] - root[:-STEPS], axis=1) for root in roots])
    minutes = sum(map(len, roots)) / RATE_HZ / 60
    return [
        Check("minutes in all", minutes, "min", 1, 0.5, "higher"),
        Check(
            "share of two-second motions that go further than 0.5 m",
            float((way > 0.5).mean()),
            "share",
            0.2,
            0.05,
            "higher",
        ),
    ]


def _shell() -> list[Sheet]:
    x, y, z = WIDTH_M / 2, HEIGHT_M, DEPTH_M / 2
    unpainted = lambda width, height: np.zeros((2, 2, 3), np.uint8)  # noqa: E731
    edges = (
        ((-x, y, -z), (2 * x, 0, 0), (0, -y, 0)),
        ((x, y, z), (-2 * x, 0, 0), (0, -y, 0)),
        ((-x, y, z), (0, 0, -2 * z), (0, -y, 0)),
        ((x, y, -z), (0, 0, 2 * z), (0, -y, 0)),
        ((-x, 0, -z), (2 * x, 0, 0), (0, 0, 2 * z)),
    )
    return [sheets.flat(*edge, unpainted) for edge in edges]
