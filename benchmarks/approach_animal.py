"""A cat whose true reactions are known: an hour of its simulated life for training, and the cat itself for testing.

`simulated_build` simulates cat and person in furnished homes, where the person walks up at all speeds, and trains a
behavior model: OUT can then be opened like a build. `TrueWorld` opens it with the cat that was simulated in
place of the model, at the same moments in the same homes, so that a policy that learned with the model is tested on
the animal. The true cat flees by its rule (`stages.synthesize_capture.policy`).
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.behavior_builds import SESSION_S, TAKES, slice_sessions, train_model
from pipeline.behavior.avoidance import clearance_of
from pipeline.behavior.trajectories import RATE_HZ, BehaviorData, Context
from pipeline.core.videos import Split
from pipeline.environments.config import EnvironmentConfig
from pipeline.environments.residents import Resident
from pipeline.environments.world import AnimalWorld
from pipeline.geometry import rigid
from stages.read_trajectories.motion import CLIP_GAP_S, MeasuredMotion
from stages.synthesize_capture import camera_motion, dwellings, gait, session
from stages.synthesize_capture.camera_motion import ARM_M
from stages.synthesize_capture.lives.lives import rest
from stages.synthesize_capture.observer import AT_HOME, ObserverStyle
from stages.synthesize_capture.policy import DELAY_S, STEP_S, Policy, SeenWalker
from stages.synthesize_capture.room import Room
from stages.synthesize_capture.voxels import volume_of
from stages.train_behavior.config import (
    AugmentationConfig,
    BehaviorOptimizerConfig,
    BehaviorTrainingConfig,
    ObjectiveConfig,
)
from stages.train_behavior.config import Config as TrainingConfig

HOMES, TEST_HOMES, TEST_SESSIONS = 24, 3, 4
"""Homes to learn from, a session each, further homes for testing, and sessions in each of these."""
WALKS_UP = replace(AT_HOME, approach_m_s=(0.15, 1.3), approach_s=(4.0, 10.0))
"""A person who walks up to the cat at all speeds, slow ones for longer; `AT_HOME` knows none below 0.8 m/s."""
ON = replace(WALKS_UP, approach_s=(10.0, 25.0))
LEARNED_FROM = (ON, replace(ON, approach_m_s=(0.1, 0.5)))
"""Persons of the takes to learn from, in turn: both walk on until they reach the cat, the second slowly."""
MODEL = TrainingConfig(
    export=False,
    ensemble_size=1,
    training=BehaviorTrainingConfig(
        BehaviorOptimizerConfig(steps=1900, goal_steps=1500, goal_batch=128, rate=4e-3),
        AugmentationConfig(past=0.05, hide_bones=0.2, approached=0.25, approached_paths=0.5),
        ObjectiveConfig(weighting="flow", code_dropout=0.0, path_share=1.0, body_share=0.25),
    ),
)
"""As in `agents/benchmark.toml`, with three times the steps for goals and less than half for paths and bodies: goals
are as accurate after 500 steps, but regard less what the person does."""
STEPS = round(1 / (RATE_HZ * STEP_S))
"""Steps of the cat per step of the environment."""
SAME_M, TURN_M = 0.001, 0.2
"""Moments of a session are taken for the same if the cat is this close, counting so many meters per radian."""
CALM_S = 0.8
"""How long the person has stood when an episode begins."""


def home_of(number: int, session_number: int) -> tuple[Room, np.random.Generator]:
    """Return a home with its loose things as in one of its sessions, and what decides the rest of the session."""
    home = dwellings.furnish_otherwise(np.random.default_rng([0, 10, number]))
    rng = np.random.default_rng([0, 14, number, session_number])
    return dwellings.rearranged(home, rng), rng


def session_names() -> dict[str, tuple[int, int]]:
    """Return home and number of each session by name."""
    counts = [1] * HOMES + [TEST_SESSIONS] * TEST_HOMES
    return {f"home{home}-{each}": (home, each) for home, count in enumerate(counts) for each in range(count)}


def simulated_session(
    home: Room,
    rng: np.random.Generator,
    persons: Sequence[ObserverStyle] = (WALKS_UP,),
    watch: Callable[[Policy], None] = lambda _: None,
) -> MeasuredMotion:
    """Simulate cat and person in a home in several takes, with these ``persons`` in turn.

    ``watch`` is called with the cat after every step.
    """
    time = np.arange(round(SESSION_S / TAKES * RATE_HZ)) / RATE_HZ
    sample = np.round(time / session.STEP_S).astype(int)
    roots, bones, cameras = [], [], []
    for take_number in range(TAKES):
        person = persons[take_number % len(persons)]
        take = session.simulate_session(home, rng, SESSION_S / TAKES, person, watch=watch)
        motion = gait.poses(take.animal, time)
        roots.append(motion.world_from_agent)
        bones.append(motion.agent_from_bone.astype(np.float32))
        cameras.append(camera_motion.filming(take, rng)[sample])
    clock = np.concatenate([time + number * (time[-1] + CLIP_GAP_S) for number in range(TAKES)])
    motion = np.concatenate(roots), np.concatenate(bones), np.concatenate(cameras)
    return MeasuredMotion(clock, *motion, rest(), volume_of(home))


def simulated_build(out: Path) -> None:
    """Simulate sessions, slice them into windows and train the model, unless ``out`` has it."""
    if (out / "behavior" / "behavior.json").is_file():
        return
    slice_sessions(_sessions(), out)
    train_model(out, MODEL, "behavior")


def _sessions() -> Iterator[tuple[str, Split, MeasuredMotion]]:
    for name, (home, number) in session_names().items():
        if home < HOMES:
            yield name, "train", simulated_session(*home_of(home, number), LEARNED_FROM)
        else:
            yield name, "test", simulated_session(*home_of(home, number))


def remembered(cat: Policy) -> Policy:
    """Return a copy of a cat in its present state, in the same home."""
    shared = (cat.rng, cat.walker.floor, cat.places, *cat.places)
    return deepcopy(cat, {id(each): each for each in shared})


@cache
def lived(name: str) -> list[Policy]:
    """Simulate a session again, and return the cat as it was after every step."""
    cats: list[Policy] = []
    simulated_session(*home_of(*session_names()[name]), watch=lambda cat: cats.append(remembered(cat)))
    return cats


@dataclass(frozen=True)
class RootFrames:
    """One frame of all cats, as much of `PoseFrames` as observations read."""

    root: Float[np.ndarray, "animal 1 4 4"]


class TrueCats:
    """The cats themselves, with the interface of `AnimalBatch` as far as `AnimalWorld` uses it."""

    def __init__(self, data: BehaviorData):
        self.data, self.clearance_m, self.plans_drawn = data, clearance_of(data.agent_from_bone_rest), 0

    def begin(self, context: Context, rng: np.random.Generator, **_: Any) -> None:
        """Start cats as they were where the windows end, with the person as there."""
        assert context.video is not None
        self.video, self.past = context.video, deque(maxlen=2)
        self.cats = [
            self._cat(*row, rng) for row in zip(context.video, context.world_from_agent, strict=True)
        ]
        self.root_m = context.world_from_agent[:, -1, 1, 3] - [cat.height for cat in self.cats]
        person = self._bodies(context.observer_world[:, -1])
        still = np.zeros(2)
        count = max(1, round(DELAY_S / STEP_S))
        self.seen = [deque([SeenWalker(place, still)] * count, count) for place in person]
        self.person = person
        self.past.extend([self._frame()] * 2)

    def _cat(self, video: int, root: Float[np.ndarray, "past 4 4"], rng: np.random.Generator) -> Policy:
        """Return the cat as it was at the end of a window, with what it had in mind."""
        cats = lived(self.data.videos[video])
        off = np.linalg.norm([cat.walker.position for cat in cats] - root[-1, [0, 2], 3], axis=1)
        ahead = np.arctan2(root[-1, 0, 2], root[-1, 2, 2])
        off += TURN_M * np.abs(rigid.wrap(np.array([cat.walker.yaw for cat in cats]) - ahead))
        alike = np.flatnonzero(off <= off.min() + SAME_M)
        cat = remembered(cats[rng.choice(alike)])
        cat.rng, cat.calm_s = rng.spawn(1)[0], CALM_S
        return cat

    def step(self, eyes: Float[np.ndarray, "animal 3"], companions: None = None) -> None:
        """Let 0.1 s pass with the persons' phones at these positions."""
        before, self.person = self.person, self._bodies(eyes)
        velocity = (self.person - before) * RATE_HZ
        for step in range(1, STEPS + 1):
            place = before + (self.person - before) * step / STEPS
            for cat, seen, *walker in zip(self.cats, self.seen, place, velocity, strict=True):
                seen.append(SeenWalker(*walker))
                cat.step(STEP_S, seen[0])
        self.past.append(self._frame())

    @property
    def fleeing(self) -> Bool[np.ndarray, "animal"]:
        """Whether the cat has been startled and runs."""
        return np.array([cat.reason == "flee" and not cat.walker.arrived() for cat in self.cats])

    @property
    def past_world(self) -> Float[np.ndarray, "animal past_frame 3"]:
        """Past positions of the cats, the current ones last; meters."""
        return np.concatenate([frame.root[..., :3, 3] for frame in self.past], axis=1)

    def _bodies(self, eyes: Float[np.ndarray, "animal 3"]) -> Float[np.ndarray, "animal 2"]:
        """Return where persons stand who hold their phones towards the cats."""
        toward = np.array([cat.walker.position for cat in self.cats]) - eyes[:, [0, 2]]
        return eyes[:, [0, 2]] - ARM_M * toward / np.maximum(
            np.linalg.norm(toward, axis=1, keepdims=True), ARM_M
        )

    def _frame(self) -> RootFrames:
        turn = np.array([[0.0, cat.walker.yaw, 0.0] for cat in self.cats])
        place = np.array([cat.position for cat in self.cats]) + self.root_m[:, None] * [0.0, 1.0, 0.0]
        return RootFrames(rigid.make(rigid.rotation_from_vector(turn), place)[:, None])


class TrueWorld(AnimalWorld):
    """A world of persons and the cats themselves; flight is what they decide, not what a model plans."""

    @classmethod
    def of(cls, out: Path, config: EnvironmentConfig) -> "TrueWorld":
        """Open what `simulated_build` wrote."""
        world = cls({"cat": Resident.load(out)}, config)
        world.batches = {"cat": TrueCats(world.habitat.data)}  # pyright: ignore[reportAttributeAccessIssue]
        return world

    @property
    def fleeing(self) -> Bool[np.ndarray, "animal"]:
        """Whether the cats flee."""
        return self.animals.fleeing  # pyright: ignore[reportAttributeAccessIssue]
