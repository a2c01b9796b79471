"""How fast behaviour is learned: steps a second, and how long until goals are nearly as good as they become.

    python -m benchmarks.behavior_training cat

Needs a finished `behavior_data`. Perception and goals learn first and alone, as the recipe has it; here that
part is trained anew for a share of its steps at a time, each with its own schedule, and judged on the test
windows. Time is CPU time of one thread (on a GPU wall-clock time) of the training whole, scaling of the
windows included, reading not. The paper's 3-D scene encoder (`[train_behavior] scene = "volume"`) takes a few
steps beside ours, for its pace.
"""

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.planning import Sampler, TorchNetworks
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import TEST, BehaviorData
from pipeline.core import config
from pipeline.metrics.scores import SCORES
from pipeline.rivals.predictors import Ats
from stages.train_behavior.config import Config
from stages.train_behavior.outcome import architecture_for
from stages.train_behavior.training import TrainedBehavior, train

SHARES = (0.125, 0.25, 0.5, 1.0)
ENOUGH = 1.1
SAMPLES = 16
PACED = {"ours": ("pillars", 10, 50), "3-D scene encoder": ("volume", 1, 3)}
"""scene encoder, and two lengths of training, whose difference is free of what it costs before its first
step"""


@dataclass(frozen=True)
class Ground:
    """What is learned from, and where."""

    data: BehaviorData
    scenes: Scenes
    device: str

    def clock(self) -> float:
        """Return seconds: of this thread's CPU, or on a GPU of the wall once it rests."""
        if self.device == "cpu":
            return time.process_time()
        torch.cuda.synchronize()
        return time.perf_counter()

    def trained(self, settings: Config, steps: int, goal_steps: int) -> tuple[float, TrainedBehavior]:
        """Return the seconds of a training, and the model."""
        pace = replace(settings.training.optimization, steps=steps, goal_steps=goal_steps)
        architecture, begin = architecture_for(settings, self.data, self.scenes), self.clock()
        training = replace(settings.training, optimization=pace)
        fitted = train(
            self.data,
            self.scenes,
            architecture,
            Schedule(course=settings.schedule),
            training,
            seed=settings.seed,
            device=self.device,
        )
        return self.clock() - begin, fitted


def goal_minde_m(ground: Ground, settings: Config, fitted: TrainedBehavior) -> float:
    """Return the mean distance of the best of 16 goals from the true one on every second test window."""
    architecture = architecture_for(settings, ground.data, ground.scenes)
    sampler = Sampler(TorchNetworks(fitted.nets.cpu()), Schedule(course=settings.schedule), fitted.scaling)
    ats = Ats(
        sampler, ground.scenes, ground.data.agent_from_bone_rest, architecture.ego, PlanSamplingConfig()
    )
    context, future = ground.data.windows(ground.data.indices(TEST)[::2])
    return float(SCORES["goal_minde_m"](ats.goals(context, SAMPLES, np.random.default_rng(0)), future).mean())


def pace(ground: Ground, settings: Config, short: int, long: int) -> tuple[float, float]:
    """Return steps a second while goals learn, and while paths and bodies do."""
    goals = [ground.trained(settings, steps, steps)[0] for steps in (short, long)]
    sequences = [ground.trained(settings, steps + 1, 1)[0] for steps in (short, long)]
    return (long - short) / (goals[1] - goals[0]), (long - short) / (sequences[1] - sequences[0])


def main() -> None:
    """Train, judge and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("agent")
    parser.add_argument("--build", type=Path, default=Path("build"))
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    given = parser.parse_args()
    torch.set_num_threads(1)
    build = given.build / given.agent
    settings = config.load(Config, build / "plan/configs/behavior.json")
    data = BehaviorData.load(build / "behavior_data")
    ground = Ground(data, Scenes.load(build / "behavior_data", data.videos), given.device)
    for name, (scene, *lengths) in PACED.items():
        goals, sequences = pace(ground, replace(settings, scene=scene), *lengths)
        print(f"{name}: {goals:.2g} steps/s of goals, {sequences:.2g} of paths and bodies", flush=True)
    found = []
    for share in SHARES:
        steps = round(share * settings.training.optimization.goal_steps)
        seconds, fitted = ground.trained(settings, steps, steps)
        found.append((seconds, goal_minde_m(ground, settings, fitted)))
        print(f"{steps:5} steps of goals: {seconds:6.1f} s, goal minDE {found[-1][1]:.3f} m", flush=True)
    enough = min(seconds for seconds, error in found if error <= ENOUGH * found[-1][1])
    print(f"within {ENOUGH} of the last: {enough:.1f} s")


if __name__ == "__main__":
    main()
