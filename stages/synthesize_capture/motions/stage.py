"""The stage: a seed -> the animal's body, homes, and its motion in them at 30 fps."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core import progress
from pipeline.data import qa
from pipeline.data.qa import Check
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from pipeline.longterm import simulated_lives
from pipeline.longterm.bodies import SkinnedBody
from pipeline.longterm.short_motions import RATE_HZ, STEPS, BodyMotion
from pipeline.longterm.simulated_lives import Split
from stages.synthesize_capture import animal, dwellings, gait, session, sheets
from stages.synthesize_capture.animal import BONES, HEADS, Animal
from stages.synthesize_capture.motions.config import Config
from stages.synthesize_capture.room import FLOOR, WALLS, Room

SESSIONS_PER_HOME = 3
"""With the home's loose things elsewhere each time; the last of each is held out."""


@dataclass(frozen=True)
class Inputs:
    """The stage reads nothing."""


def run(inputs: Inputs, config: Config, out: Path) -> None:
    """Furnish homes and let the animal live in them."""
    body = body_of(animal.grow(np.random.default_rng([config.seed, 2])))
    scenes: list[Mesh] = []
    motions: list[BodyMotion] = []
    split: list[Split] = []
    for home in range(config.homes):
        dwelling = dwellings.furnish_otherwise(np.random.default_rng([config.seed, 20, home]))
        for number in range(SESSIONS_PER_HOME):
            rng = np.random.default_rng([config.seed, 21, home, number])
            room = dwellings.rearranged(dwelling, rng)
            lived = session.simulate_session(room, rng, config.session_s)
            motion = gait.poses(lived.animal, np.arange(round(config.session_s * RATE_HZ)) / RATE_HZ)
            scenes.append(surface_of(room))
            motions.append(BodyMotion(motion.world_from_agent, motion.agent_from_bone))
            unseen, last = home == config.homes - 1 and config.homes > 1, number == SESSIONS_PER_HOME - 1
            split.append("unseen" if unseen else "held_out" if last else "train")
    progress.log(f"{len(motions)} sessions of {config.session_s:g} s in {config.homes} homes")
    simulated_lives.save(out, body, scenes, motions, list(range(len(scenes))), split)
    qa.write(
        out,
        good="an animal that is on its way half of the time",
        bad="an animal that never moves",
        checks=checks(motions),
    )


def body_of(creature: Animal) -> SkinnedBody:
    """Return the animal as a skinned body."""
    weights = np.zeros((len(creature.vertices), len(BONES)))
    np.put_along_axis(weights, creature.bone, creature.weight, axis=1)
    mesh, rest = Mesh(creature.vertices, creature.faces), rigid.make(np.eye(3)[None], HEADS)
    return SkinnedBody(mesh, weights, rest, np.zeros(0))


def surface_of(room: Room) -> Mesh:
    """Return floor, walls and all furniture as one surface that faces the free space."""
    shell = [sheets.flat(*edges, lambda *_: np.zeros((2, 2, 3), np.uint8)) for edges in (*WALLS, FLOOR)]
    vertices, faces, _, _ = sheets.triangles([*shell, *room.sheets()])
    return Mesh(vertices, faces)


def checks(motions: list[BodyMotion]) -> list[Check]:
    """Judge the sessions."""
    roots = [each.world_from_agent[:, :3, 3] for each in motions]
    way = np.concatenate([np.linalg.norm(root[STEPS:] - root[:-STEPS], axis=1) for root in roots])
    minutes, far = sum(map(len, roots)) / RATE_HZ / 60, float((way > 0.5).mean())
    return [
        Check("minutes in all", minutes, "min", 1, 0.5, "higher"),
        Check("share of two-second motions that go further than 0.5 m", far, "share", 0.2, 0.05, "higher"),
    ]
