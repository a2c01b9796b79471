"""The same approaches sampled by the page and by Python, with the same noise. `approaches` scripts them from
recorded moments, `goals_of_page` and `goals_of_python` sample a goal for each, `Answers.away_m` is its shift
away from the approaching observer.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from playwright.sync_api import Page

from pipeline.baselines.predictors import Ats
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.planning import Observation, observe
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import FUTURE, PAST, RATE_HZ, BehaviorData, Context, window_starts
from pipeline.geometry import rigid
from tests.stages.export_simulator.reaction import FAR_M

STEPS = 10
ASK = """async (text) => {
  const goals = [];
  for (const question of JSON.parse(text)) goals.push((await ats.sampleGoals(question))[0]);
  return goals;
}"""


class Anticipating(Ats):
    """The model as the page samples it: the observer is expected to go on as now."""

    def observe(self, context: Context) -> Observation:
        """Encode a context."""
        return observe(context, self.scenes, self.agent_from_bone_rest, self.ego, FUTURE)


@dataclass(frozen=True)
class Approaches:
    """Recorded moments with observer tracks of the last 0.8 s: near, distant, or distant on the opposite
    side.
    """

    context: Context
    """its own observers are not used"""
    side: Float[np.ndarray, "plan 2"]
    """from the animal to the observer, on the floor"""
    near: Float[np.ndarray, "plan 8 2"]
    far: Float[np.ndarray, "plan 8 2"]
    opposite: Float[np.ndarray, "plan 8 2"]
    seed: Int[np.ndarray, "plan"]


@dataclass(frozen=True)
class Answers:
    """Goals of the same plans, meters on the floor, per position of the observer; and with interactivity 0."""

    near: Float[np.ndarray, "plan 2"]
    far: Float[np.ndarray, "plan 2"]
    opposite: Float[np.ndarray, "plan 2"]
    ignored: Float[np.ndarray, "plan 2"]

    def away_m(self, side: Float[np.ndarray, "plan 2"]) -> Float[np.ndarray, "plan"]:
        """Return the shift of each goal away from the near observer."""
        return -((self.near - self.far) * side).sum(-1)

    def rate(self, side: Float[np.ndarray, "plan 2"], further_m: float = 0.1) -> float:
        """Return the fraction of plans whose goals shift away by more than this."""
        return float((self.away_m(side) > further_m).mean())


class PageNoise:
    """The random generator of the page, one stream per plan: mulberry32 and Box-Muller (`noise.js`)."""

    def __init__(self, seeds: Int[np.ndarray, "plan"]):
        self.streams = [_uniforms(int(seed)) for seed in seeds]

    def standard_normal(self, shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
        """Draw the samples of the page for every plan (first axis)."""
        count = 2 * int(np.prod(shape[1:]))
        draws = np.array([[next(stream) for _ in range(count)] for stream in self.streams]).reshape(
            len(self.streams), -1, 2
        )
        return (
            (np.sqrt(-2 * np.log(1 - draws[..., 0])) * np.cos(2 * np.pi * draws[..., 1]))
            .reshape(shape)
            .astype(dtype)
        )


def _uniforms(seed: int) -> Iterator[float]:
    state, mask = seed, 0xFFFFFFFF
    while True:
        state = (state + 0x6D2B79F5) & mask
        mixed = ((state ^ (state >> 15)) * (state | 1)) & mask
        mixed ^= (mixed + (mixed ^ (mixed >> 7)) * (mixed | 61)) & mask
        yield (mixed ^ (mixed >> 14)) / 2**32


def approaches(data: BehaviorData, count: int, rng: np.random.Generator) -> Approaches:
    """Script straight approaches to the animal from random recorded moments, ending at 0.4 to 2.4 m, at 0.3
    to 1.2 m/s.
    """
    moments = [
        (track, start) for track in data.trajectories.values() for start in window_starts(track.valid, PAST)
    ]
    drawn = [moments[i] for i in rng.integers(len(moments), size=count)]
    agent = np.stack([track.world_from_agent[start : start + PAST] for track, start in drawn])
    bones = np.stack([track.agent_from_bone[start : start + PAST] for track, start in drawn]).astype(
        np.float64
    )
    angle = rng.uniform(0, 2 * np.pi, count)
    side = np.stack([np.cos(angle), np.sin(angle)], -1)
    before_s = np.arange(PAST - 1, -1, -1) / RATE_HZ
    distance_m = rng.uniform(0.4, 2.4, (count, 1)) + rng.uniform(0.3, 1.2, (count, 1)) * before_s
    here = agent[:, -1:, :3, 3][..., [0, 2]]
    stand = np.full((1, PAST, 1), FAR_M)
    return Approaches(
        Context(agent, bones, np.zeros((count, PAST, 3))),
        side,
        here + distance_m[..., None] * side[:, None],
        here + stand * side[:, None],
        here - stand * side[:, None],
        rng.integers(2**20, size=count),
    )


def goals_of_page(page: Page, met: Approaches, checks: int) -> Answers:
    """Sample goals in an open page; the last two only for the first ``checks`` plans."""
    past = np.concatenate(
        [rows(met.context.world_from_agent[:, :, None]), rows(met.context.agent_from_bone)], axis=2
    )
    past = past.reshape(*past.shape[:2], -1)

    def goals(observer: np.ndarray, **more: object) -> np.ndarray:
        questions = [
            {
                "past": rows.tolist(),
                "observer": places.tolist(),
                "seed": int(seed),
                "K": 1,
                "steps": STEPS,
                "interactivity": 1,
                **more,
            }
            for rows, places, seed in zip(
                past[: len(observer)], observer, met.seed[: len(observer)], strict=True
            )
        ]
        return np.array(page.evaluate(ASK, json.dumps(questions)))[:, [0, 2]]

    few = slice(checks)
    return Answers(
        goals(met.near), goals(met.far), goals(met.opposite[few]), goals(met.near[few], interactivity=0)
    )


def goals_of_python(build: Path, simulator: Path, met: Approaches, checks: int) -> Answers:
    """Sample goals in Python; the last two only for the first ``checks`` plans."""
    contract = json.loads((simulator / "simulator.json").read_bytes())
    eyes_m = contract["scene"]["floor_m"] + contract["observer"]["eye_height_m"]
    settings = contract["behavior"]["sampling"]
    scenes = Scenes.load(build / "behavior_data", ("any",))

    def goals(observer: np.ndarray, guidance: float = 1.0) -> np.ndarray:
        count = len(observer)
        sampling = PlanSamplingConfig(settings["method"], max(STEPS, settings["goal_steps"]), STEPS, guidance)
        ats = Anticipating.load(build / "behavior", scenes, sampling)
        eyes = np.stack([observer[..., 0], np.full(observer.shape[:2], eyes_m), observer[..., 1]], -1)
        parts = []
        for some in np.array_split(
            np.arange(count), -(-count // 32)
        ):  # one plan per window: noise belongs to the plan
            context = Context(
                met.context.world_from_agent[some], met.context.agent_from_bone[some], eyes[some]
            )
            parts.append(ats.goals(context, 1, PageNoise(met.seed[some])).goal[:, 0])
        return np.concatenate(parts)[:, [0, 2]]

    few = slice(checks)
    return Answers(
        goals(met.near), goals(met.far), goals(met.opposite[few]), goals(met.near[few], guidance=0.0)
    )


def rows(a_from_b: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 7"]:
    """Return rigid transforms as rows of position and quaternion wxyz, the format of the page."""
    return np.concatenate(
        [a_from_b[..., :3, 3], rigid.quaternion_from_rotation(a_from_b[..., :3, :3])], axis=-1
    )
