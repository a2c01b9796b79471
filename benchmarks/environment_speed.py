"""Animal-steps per CPU second (one thread) of the vectorized environment and of sequential simulation.

    python -m benchmarks.environment_speed build/toy --count 32 --steps 100

Persons walk at random. Both are measured in one run with the few-step sampler; the sequential simulation also with
the default sampler. Plans per step show how long plans are followed.
"""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks import command_lines
from pipeline.behavior.config import PlanSamplingConfig, ReplanningConfig
from pipeline.behavior.simulator import Simulator
from pipeline.environments.config import EnvironmentConfig
from pipeline.environments.spaces import person_observation
from pipeline.environments.world import AnimalWorld

SEQUENTIAL_REDUCTION = 8
"""Factor by which fewer animals are simulated sequentially."""


def vectorized_speed(world: AnimalWorld, count: int, steps: int) -> tuple[float, float]:
    """Return animal-steps per second and plans per animal-step of ``count`` lives in parallel."""
    rng = np.random.default_rng(0)
    world.begin(count, rng)
    start, planned = time.process_time(), sum(batch.plans_drawn for batch in world.batches.values())
    for _ in range(steps):
        world.step(rng.uniform(-1, 1, (count, world.action_size)))
        person_observation(world)
    seconds, lived = time.process_time() - start, count * steps * len(world.batches)
    drawn = sum(batch.plans_drawn for batch in world.batches.values()) - planned
    return lived / seconds, drawn / lived


def sequential_speed(
    world: AnimalWorld, sampling: PlanSamplingConfig, chaining: ReplanningConfig, count: int, steps: int
) -> float:
    """Return animal-steps per second of `Simulator`."""
    single = Simulator(
        world.animals.sampler,
        world.habitat.data,
        world.habitat.scenes,
        world.animals.ego,
        sampling=sampling,
        chaining=chaining,
    )
    rng, seconds = np.random.default_rng(0), 0.0
    for seed in range(count):
        state = single.reset(seed)
        position = state.world_from_agent[:3, 3] + [2.0, 1.2, 0.0]
        start = time.process_time()
        for _ in range(steps):
            position = position + rng.uniform(-0.1, 0.1, 3) * [1, 0, 1]
            single.step(position)
        seconds += time.process_time() - start
    return count * steps / seconds


def main() -> None:
    """Print the speeds."""
    parser = command_lines.described(__doc__)
    parser.add_argument("build", type=Path)
    parser.add_argument("--count", type=int, default=32)
    parser.add_argument("--steps", type=int, default=100)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    world = AnimalWorld.load(arguments.build, EnvironmentConfig())
    speed, plans = vectorized_speed(world, arguments.count, arguments.steps)
    print(f"{arguments.count} in parallel: {speed:.0f} animal-steps/s, {plans:.3f} plans per animal-step")
    few_step, chaining = world.animals.sampling, world.animals.chaining
    sequential_count = max(arguments.count // SEQUENTIAL_REDUCTION, 1)
    sequential = sequential_speed(world, few_step, chaining, sequential_count, arguments.steps)
    print(f"sequential, same sampler: {sequential:.0f} animal-steps/s")
    default_speed = sequential_speed(
        world,
        replace(few_step, **vars(PlanSamplingConfig())),
        ReplanningConfig(),
        sequential_count,
        arguments.steps,
    )
    print(f"sequential, default sampler: {default_speed:.0f} animal-steps/s")


if __name__ == "__main__":
    main()
