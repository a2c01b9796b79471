"""What few denoising steps save and cost: CPU seconds of one plan through ONNX Runtime on one core, beside
its accuracy.

    python -m benchmarks.behavior_sampling build/cat

A plan is goal, path and body, K = 1. Accuracy is that of the best of 16 goals and paths on some test windows
of the build (training windows where it has none), with the same noise for every number of steps.
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime

from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.perception import world_from_ego
from pipeline.behavior.planning import Array, Networks, Observation, Sampler, observe
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import TEST, TRAIN, BehaviorData
from pipeline.geometry import rigid
from pipeline.rivals.predictors import Ats

STEPS = ((50, 50), (50, 10), (25, 10), (10, 10), (10, 5), (5, 5))
"""denoising steps of the goal, and of path and body"""
SAMPLES = 16


class OnnxNetworks:
    """`Networks` by ONNX Runtime on one thread, as the page has them."""

    def __init__(self, folder: Path):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        names = ("perception", "goal", "path", "body")
        self.sessions = {
            name: onnxruntime.InferenceSession(folder / f"{name}.onnx", options) for name in names
        }

    def _run(self, name: str, *arguments: Array) -> Array:
        session = self.sessions[name]
        given = {
            put.name: np.ascontiguousarray(value, np.float32)
            for put, value in zip(session.get_inputs(), arguments, strict=True)
        }
        return session.run(None, given)[0]

    def perceive(self, *arguments: Array) -> Array:
        return self._run("perception", *arguments)

    def goal(self, x: Array, t: Array, condition: Array) -> Array:
        return self._run("goal", x, t, np.repeat(condition, len(x) // len(condition), axis=0))

    def path(self, *arguments: Array) -> Array:
        return self._run("path", *arguments)

    def body(self, *arguments: Array) -> Array:
        return self._run("body", *arguments)


@dataclass(frozen=True)
class Cost:
    """What one number of steps costs and brings."""

    steps: tuple[int, int]
    seconds: float
    goal_minde_m: float
    path_minade_m: float


def plan_seconds(
    networks: Networks, ats: Ats, observation: Observation, sampling: PlanSamplingConfig, repeats: int
) -> float:
    """Return the CPU seconds of one plan, the smallest of some repeats after one to warm up."""
    sampler, seconds = Sampler(networks, ats.sampler.schedule, ats.sampler.scaling), []
    for _ in range(repeats + 1):
        begin = time.process_time()
        sampler.plan(observation, sampling, np.random.default_rng(0))
        seconds.append(time.process_time() - begin)
    return min(seconds[1:])


def observation_of(ats: Ats, data: BehaviorData, index: np.ndarray) -> Observation:
    """Return what the animal perceives in some windows."""
    return observe(data.windows(index)[0], ats.scenes, ats.agent_from_bone_rest, ats.ego)


def accuracy(
    ats: Ats, data: BehaviorData, index: np.ndarray, sampling: PlanSamplingConfig
) -> tuple[float, float]:
    """Return the mean minDE of goals and minADE of paths, metres."""
    context, future = data.windows(index)
    rng, observation = np.random.default_rng(0), observation_of(ats, data, index)
    codes = ats.sampler.codes(observation, sampling, SAMPLES)
    goals = ats.sampler.goals(codes, sampling, rng)
    paths = ats.sampler.paths(codes, goals, sampling, rng).reshape(len(context), SAMPLES, -1, 3)
    ego_from_world = rigid.inverse(world_from_ego(context.world_from_agent[:, -1], ats.ego))
    true = rigid.apply(ego_from_world, future.path_world)[:, None]
    goal_error = np.linalg.norm(goals.reshape(len(context), SAMPLES, 3) - true[:, :, -1], axis=-1)
    return float(goal_error.min(1).mean()), float(
        np.linalg.norm(paths - true, axis=-1).mean(-1).min(1).mean()
    )


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "build", type=Path, help="where `behavior_data` and `behavior` lie, for example build/cat"
    )
    parser.add_argument("--windows", type=int, default=24, help="how many windows to judge on")
    parser.add_argument("--repeats", type=int, default=5, help="of the timing")
    given = parser.parse_args()
    data = BehaviorData.load(given.build / "behavior_data")
    scenes = Scenes.load(given.build / "behavior_data", data.videos)
    ats, networks = (
        Ats.load(given.build / "behavior", scenes, PlanSamplingConfig()),
        OnnxNetworks(given.build / "behavior"),
    )
    split = data.indices(TEST) if len(data.indices(TEST)) else data.indices(TRAIN)
    index = split[np.linspace(0, len(split) - 1, given.windows).astype(int)]
    observation = observation_of(ats, data, index[:1])
    found = []
    for steps in STEPS:
        sampling = PlanSamplingConfig(goal_steps=steps[0], sequence_steps=steps[1])
        found.append(
            Cost(
                steps,
                plan_seconds(networks, ats, observation, sampling, given.repeats),
                *accuracy(ats, data, index, sampling),
            )
        )
    base = found[0]
    print("| steps goal / sequences | CPU s a plan | goal minDE m | path minADE m |\n|---|---|---|---|")
    for cost in found:
        pairs = ((cost.goal_minde_m, base.goal_minde_m), (cost.path_minade_m, base.path_minade_m))
        change = [f"{ours:.3f} ({ours / theirs - 1:+.1%})" for ours, theirs in pairs]
        print(f"| {cost.steps[0]} / {cost.steps[1]} | {cost.seconds:.3f} | {change[0]} | {change[1]} |")


if __name__ == "__main__":
    main()
