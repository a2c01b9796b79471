"""Animal-steps per CPU second (one thread) of the vectorised environment against one animal after the other,
in one run on one core.

    python -m benchmarks.environment_speed build/toy --count 32 --steps 100

Persons walk at random; both simulate as many animals for as many steps, few-step sampling for both, and the
loop once more with the default sampler. Plans per step say how long plans are followed.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from pipeline.behavior.config import PlanSamplingConfig, ReplanningConfig
from pipeline.behavior.simulator import Simulator
from pipeline.environments.config import EnvironmentConfig
from pipeline.environments.spaces import person_observation
from pipeline.environments.world import AnimalWorld

LOOP_SHARE = 8
"""One animal after the other is timed with so many times fewer animals."""


def many_at_once(world: AnimalWorld, count: int, steps: int) -> tuple[float, float]:
    """Return animal-steps per second and plans per animal and step of ``count`` animals."""
    rng = np.random.default_rng(0)
    world.begin(count, rng)
    begin, planned = time.process_time(), world.animals.plans_drawn
    for _ in range(steps):
        world.step(rng.uniform(-1, 1, (count, world.action_size)))
        person_observation(world)
    seconds = time.process_time() - begin
    return count * steps / seconds, (world.animals.plans_drawn - planned) / (count * steps)


def one_after_another(
    world: AnimalWorld, sampling: PlanSamplingConfig, chaining: ReplanningConfig, count: int, steps: int
) -> float:
    """Return animal-steps per second of `Simulator`, as it is used beside the page."""
    single = Simulator(
        world.animals.sampler,
        world.data,
        world.scenes,
        world.animals.ego,
        sampling=sampling,
        chaining=chaining,
    )
    rng, seconds = np.random.default_rng(0), 0.0
    for seed in range(count):
        state = single.reset(seed)
        position = state.world_from_agent[:3, 3] + [2.0, 1.2, 0.0]
        begin = time.process_time()
        for _ in range(steps):
            position = position + rng.uniform(-0.1, 0.1, 3) * [1, 0, 1]
            single.step(position)
        seconds += time.process_time() - begin
    return count * steps / seconds


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("build", type=Path)
    parser.add_argument("--count", type=int, default=32)
    parser.add_argument("--steps", type=int, default=100)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    world = AnimalWorld.load(asked.build, EnvironmentConfig())
    speed, plans = many_at_once(world, asked.count, asked.steps)
    print(f"{asked.count} at once: {speed:.0f} animal-steps/s, {plans:.3f} plans per animal and step")
    few, chaining = world.animals.sampling, world.animals.chaining
    some = max(asked.count // LOOP_SHARE, 1)
    loop = one_after_another(world, few, chaining, some, asked.steps)
    print(f"one after another, same sampler: {loop:.0f} animal-steps/s")
    default = one_after_another(
        world, replace(few, **vars(PlanSamplingConfig())), ReplanningConfig(), some, asked.steps
    )
    print(f"one after another, default sampler: {default:.0f} animal-steps/s")


if __name__ == "__main__":
    main()
