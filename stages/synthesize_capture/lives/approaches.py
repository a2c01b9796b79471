"""Scripted approaches: a person stands, then walks up to the animal; in its twin the person goes on standing.

What the animal's true policy does in either case is what a behavior model should do when it is shown the
same 0.8 s.
"""

import copy
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.trajectories import FUTURE, PAST
from pipeline.data import npz
from stages.synthesize_capture import gait
from stages.synthesize_capture.dwellings import rearranged
from stages.synthesize_capture.lives.lives import RATE_HZ
from stages.synthesize_capture.navigation import ANIMAL_M, PERSON_M, floor_for
from stages.synthesize_capture.observer import Observer
from stages.synthesize_capture.policy import DELAY_S, STEP_S, Policy, SeenWalker
from stages.synthesize_capture.room import Room
from stages.synthesize_capture.session import AnimalCourse, course_from_rows, course_row
from stages.synthesize_capture.voxels import volume_of

CALM_S = 2.0
"""The person stands that long first."""
WALKED_S = 0.9
"""After so much walking the model is asked what comes next."""
FAR_M = (2.4, 3.0)
"""Between animal and person at first."""
EYE_M = 1.35
"""Height of the phone."""


@dataclass(frozen=True)
class ScriptedApproaches:
    """Windows of approaches and, one for one, of their twins; the current frame is the last of the past."""

    world_from_agent: Float[np.ndarray, "twin approach frame 4 4"]
    """Twin 0: the person walks up; twin 1: it stands. 8 past and 56 future frames."""
    agent_from_bone: Float[np.ndarray, "twin approach past bone 4 4"]
    observer: Float[np.ndarray, "twin approach past 3"]
    volume: FeatureVolume


def scripted(home: Room, rng: np.random.Generator, count: int) -> ScriptedApproaches:
    """Play ``count`` approaches and their twins, each from a place and a mood of its own."""
    home = rearranged(home, rng)
    ground, floor = (floor_for(home.obstacles(), size_m) for size_m in (ANIMAL_M, PERSON_M))
    windows = []
    while len(windows) < count:
        begin = ground.centers()[rng.integers(ground.free.sum())]
        away = np.linalg.norm(floor.centers() - begin, axis=-1)
        near = floor.centers()[(away > FAR_M[0]) & (away < FAR_M[1])]
        if not len(near):
            continue
        animal = Policy(ground, home.places, begin, rng.spawn(1)[0])
        person = Observer(floor, near[rng.integers(len(near))], rng.spawn(1)[0])
        windows.append(_pair(animal, person, rng.uniform(0.9, 1.2)))
    columns = [np.stack([[pair[twin][part] for pair in windows] for twin in (0, 1)]) for part in range(3)]
    return ScriptedApproaches(*columns, volume=volume_of(home))


def _pair(animal: Policy, person: Observer, speed_m_s: float) -> tuple[tuple[np.ndarray, ...], ...]:
    """Play one approach and its twin from one start: the animal chooses alike until it notices."""
    twins = []
    for walks in (True, False):
        rows, seen = _played(copy.deepcopy(animal), copy.deepcopy(person), speed_m_s if walks else None)
        now = CALM_S + WALKED_S
        timestamp_s = now + np.arange(1 - PAST, FUTURE + 1) / RATE_HZ
        motion = gait.poses(rows, timestamp_s)
        sample = np.round(timestamp_s[:PAST] / STEP_S).astype(int)
        bones = motion.agent_from_bone[:PAST].astype(np.float32)
        twins.append((motion.world_from_agent, bones, seen[sample]))
    return tuple(twins)


def _played(
    animal: Policy, person: Observer, speed_m_s: float | None
) -> tuple[AnimalCourse, Float[np.ndarray, "sample 3"]]:
    """Let both live; the person stands, and after a while walks up at ``speed_m_s``, if given."""
    past: deque[SeenWalker] = deque(maxlen=max(1, round(DELAY_S / STEP_S)))
    person.mode, person.left_s = "watch", np.inf
    rows, seen = [], []
    for step in range(int(np.ceil((CALM_S + WALKED_S + FUTURE / RATE_HZ + 0.5) / STEP_S))):
        if speed_m_s is not None and step == round(CALM_S / STEP_S):
            person.mode, person.speed_m_s, person.left_s, person.since_plan_s = (
                "approach",
                speed_m_s,
                4.0,
                np.inf,
            )
        if person.mode != "approach":
            person.left_s = np.inf
        person.step(STEP_S, animal.position)
        past.append(SeenWalker(person.walker.position.copy(), person.velocity.copy()))
        animal.step(STEP_S, past[0])
        rows.append(course_row(animal))
        seen.append([person.walker.position[0], EYE_M, person.walker.position[1]])
    return course_from_rows(rows), np.array(seen)


def write(folder: Path, met: ScriptedApproaches) -> None:
    """Write `approaches.npz` and the home's `volume.npz`."""
    arrays = dict(vars(met))
    npz.save(folder / "volume.npz", compress=True, **vars(arrays.pop("volume")))
    npz.save(folder / "approaches.npz", compress=True, **arrays)
