"""Compare how often a simulated animal flees from a person who walks up at some speed, with the animal itself.

    python -m benchmarks.flight OUT

OUT is made first (`benchmarks.approach_animal`, 8 CPU minutes), unless it is there. Prints the share of episodes in
which the animal begins to flee before the person reaches it, by the person's speed, and of animals that flee from a
person who begins close by and stands. Both are judged by the same criterion, from where they go
(`benchmarks.approaches.flights`).
"""

from dataclasses import replace
from pathlib import Path

import torch

from benchmarks import command_lines
from benchmarks.approach_animal import TrueWorld, simulated_build
from benchmarks.approaches import OBSERVATIONS, approach_at, flights, meet, run_episodes, stand_still
from pipeline.behavior.trajectories import RATE_HZ
from pipeline.environments.config import EnvironmentConfig
from pipeline.environments.world import AnimalWorld

SPEEDS_M_S = (0.0, 0.2, 0.4, 0.8, 1.2)
CLOSE_STARTS_M = ((0.3, 0.5), (0.5, 0.7), (0.8, 1.1))
AT_ONCE_S, LATER_S = 1.5, 6.0
"""Reaction to who stands close by, and what else it does while that person stays."""
APPROACH_S = 20.0


def main() -> None:
    """Print both tables for the animal itself and the model."""
    parser = command_lines.described(__doc__)
    parser.add_argument("build", type=Path)
    parser.add_argument("--episodes", type=int, default=96)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    simulated_build(arguments.build)
    config = EnvironmentConfig(episode_s=APPROACH_S, observations=OBSERVATIONS)
    columns = [f"{speed:g} m/s" for speed in SPEEDS_M_S]
    columns += [f"stands at {low:g} to {high:g} m" for low, high in CLOSE_STARTS_M]
    print(f"| flees, % | {' | '.join(columns)} |\n|{'---|' * (1 + len(columns))}", flush=True)
    opened = {"the animal itself": TrueWorld.of, "model": AnimalWorld.load}
    for name, open_world in opened.items():
        cells = []
        world = open_world(arguments.build, config)
        for speed in SPEEDS_M_S:
            run = run_episodes(world, approach_at(speed), arguments.episodes)
            cells.append(f"{run.fled.mean():.0%} ({run.reached.mean():.0%} reached)")
        for start in CLOSE_STARTS_M:
            world = open_world(arguments.build, replace(config, episode_s=2 * LATER_S, start_m=start))
            begins = flights(*meet(world, stand_still, arguments.episodes))
            at_once, later = (begins[:, : round(each * RATE_HZ)].any(axis=1) for each in (AT_ONCE_S, LATER_S))
            cells.append(f"{at_once.mean():.0%} ({later.mean():.0%} in {LATER_S:g} s)")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
