"""Train PPO to walk up to the animal of a build without making it flee, and compare it with scripted policies.

    python -m benchmarks.approach_policy build/cat --seeds 5 --steps 200000 --picture approach.webp

Trains from start states in the training recordings, then compares success (the person is within 0.7 m of an
animal that does not flee) in episodes that start in the test recording: learned, straight walk, random, standing
still. Also reports how often the recorded animal fled from a nearby person, and how often sampled plans from the
same moments do. Needs the extra `rl`; one thread.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from pipeline.behavior.trajectories import RATE_HZ, TEST, TRAIN
from pipeline.core.progress import log
from pipeline.data import plots
from pipeline.environments.config import EnvironmentConfig
from pipeline.environments.spaces import person_observation
from pipeline.environments.stable_baselines import PersonStableVecEnv
from pipeline.environments.world import CLOSE_M, AnimalWorld
from pipeline.metrics.flight import flees

ENVIRONMENTS = 64
EPISODE_S = 12.0
"""Five times the duration of the longest straight walk."""
PPO_SETTINGS = {
    "n_steps": 16, "batch_size": 256, "n_epochs": 6, "learning_rate": 1e-3, "gamma": 0.98, "gae_lambda": 0.95,
    "policy_kwargs": {"log_std_init": -0.7, "net_arch": [64, 64]},
}  # fmt: skip
"""Usual values for small batches; at ten steps per second a discount of 0.98 is a horizon of five seconds. Rewards
are normalized by the running standard deviation of the returns, which reach 5; otherwise the gradient of the value
network dominates that of the policy."""
OBSERVATIONS = ("animal", "velocity")
"""Without the floor plan around the person: its 256 numbers slowed learning down several times."""
Policy = Callable[[dict[str, Float[np.ndarray, "person ..."]]], Float[np.ndarray, "person action"]]
HELD_OUT_SEED = 1000
"""Seed of start states and plans in the comparison, the same for all policies."""
PLANS = 8
"""Plans drawn at every moment with a person near; with one, the rate of flights changes by 2 points by chance."""
LAST_EPISODES = 300
"""Episodes at the end of training whose success is printed."""
DRAWN_EPISODES = 6
"""Episodes whose paths are drawn."""


@dataclass(frozen=True)
class Episodes:
    """Outcome of each episode at its first termination."""

    reached: Bool[np.ndarray, "episode"]
    fled: Bool[np.ndarray, "episode"]
    seconds: Float[np.ndarray, "episode"]
    person_paths: Float[np.ndarray, "episode step 2"]
    """Of the person, world x and z, meters; NaN after the episode has ended."""
    animal_paths: Float[np.ndarray, "episode step 2"]


def straight_walk(observation: dict[str, np.ndarray]) -> Float[np.ndarray, "person 3"]:
    """Turn towards the animal and walk to it at full speed."""
    left, ahead = observation["animal"][:, 0], observation["animal"][:, 1]
    angle = np.arctan2(left, ahead)
    speed = np.cos(angle).clip(0, 1)
    return np.stack([speed, np.zeros_like(speed), (angle * 5).clip(-1, 1)], axis=-1)


def random_walk(rng: np.random.Generator) -> Policy:
    """Return a policy that draws every action independently."""
    return lambda observation: rng.uniform(-1, 1, (len(observation["animal"]), 3))


def stand_still(observation: dict[str, np.ndarray]) -> Float[np.ndarray, "person 3"]:
    """Stand still."""
    return np.zeros((len(observation["animal"]), 3))


def trained_policy(model: PPO) -> Policy:
    """Return the mean action of a trained policy."""
    return lambda observation: model.predict(observation, deterministic=True)[0]


def run_episodes(world: AnimalWorld, policy: Policy, count: int, split: str, seed: int) -> Episodes:
    """Run ``count`` episodes in parallel until each has ended."""
    world.begin(count, np.random.default_rng(seed), split)
    frames = round(world.config.episode_s * RATE_HZ)
    reached, fled, seconds = (
        np.zeros(count, bool),
        np.zeros(count, bool),
        np.full(count, world.config.episode_s),
    )
    person_paths, animal_paths = (
        np.full((count, frames + 1, 2), np.nan),
        np.full((count, frames + 1, 2), np.nan),
    )
    for frame in range(frames):
        going = ~(reached | fled)
        person_paths[going, frame] = world.persons.position[going]
        animal_paths[going, frame] = world.animal_position[going][:, [0, 2]]
        outcome = world.step(policy(person_observation(world)))
        ended = going & (outcome.reached | outcome.flees)
        reached |= going & outcome.reached
        fled |= going & outcome.flees
        seconds[ended] = (frame + 1) / RATE_HZ
        person_paths[ended, frame + 1] = world.persons.position[ended]
        animal_paths[ended, frame + 1] = world.animal_position[ended][:, [0, 2]]
    return Episodes(reached, fled, seconds, person_paths, animal_paths)


class OutcomeRecorder(BaseCallback):
    """Records the outcome of every training episode."""

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[int] = []
        self.reached: list[bool] = []

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "reached" in info:
                self.steps.append(self.num_timesteps)
                self.reached.append(info["reached"])
        return True


def train(world: AnimalWorld, steps: int, seed: int) -> tuple[PPO, OutcomeRecorder]:
    """Train one policy."""
    env = VecNormalize(PersonStableVecEnv(world, ENVIRONMENTS), norm_obs=False, gamma=PPO_SETTINGS["gamma"])
    curve = OutcomeRecorder()
    model = PPO("MultiInputPolicy", env, seed=seed, device="cpu", **PPO_SETTINGS)
    model.learn(steps, callback=curve)
    return model, curve


def flight_rates(world: AnimalWorld, split: int) -> tuple[float, float, int]:
    """Return the flight rates of the recorded animal and of sampled plans near a person (within `CLOSE_M`), and
    the number of moments.
    """
    windows = world.data.indices(split)
    context, future = world.data.windows(windows)
    now, person = context.world_from_agent[:, -1, :3, 3], context.observer_world[:, -1]
    near = np.linalg.norm((now - person)[:, [0, 2]], axis=1) < CLOSE_M
    if not near.any():
        return np.nan, np.nan, 0
    recorded = flees(future.path_world, now, person)[near]
    planned = []
    for seed in range(PLANS):
        world.animals.begin(context[near], np.random.default_rng(seed))
        planned.append(flees(world.animals.plan.root[..., :3, 3], now[near], person[near]).mean())
    return float(recorded.mean()), float(np.mean(planned)), int(near.sum())


def table_row(name: str, runs: list[Episodes]) -> str:
    """Return one row of the table: rates over all episodes, and the range over seeds."""
    reached = [100 * run.reached.mean() for run in runs]
    fled = [100 * run.fled.mean() for run in runs]
    seconds = np.concatenate([run.seconds[run.reached] for run in runs])
    seed_range = f" ({min(reached):.0f}-{max(reached):.0f})" if len(runs) > 1 else ""
    median = f"{np.median(seconds):.1f}" if len(seconds) else "-"
    neither = 100 - np.mean(reached) - np.mean(fled)
    return f"| {name} | {np.mean(reached):.0f}{seed_range} | {np.mean(fled):.0f} | {neither:.0f} | {median} |"


def picture(world: AnimalWorld, curves: list[OutcomeRecorder], runs: dict[str, Episodes]) -> np.ndarray:
    """Plot success over training, and the paths of the first episodes in top view."""
    figure, axes = plots.panels(1, 1 + len(runs), width_in=4 * (1 + len(runs)), height_in=3.6)
    for curve in curves:
        width = max(len(curve.reached) // 12, 1)
        mean = np.convolve(curve.reached, np.ones(width) / width, "valid")
        axes[0, 0].plot(curve.steps[width - 1 :], 100 * mean, linewidth=1)
    axes[0, 0].set(
        title="training: reached without flight", xlabel="steps", ylabel="% of episodes", ylim=(0, 100)
    )
    floor = world.floors[0]
    for axis, (name, run) in zip(axes[0, 1:], runs.items(), strict=True):
        plots.floor_plan(axis, floor.blocked.astype(float), floor.corner, floor.cell_m)
        for path, animal, reached in zip(
            run.person_paths[:DRAWN_EPISODES],
            run.animal_paths[:DRAWN_EPISODES],
            run.reached[:DRAWN_EPISODES],
            strict=True,
        ):
            axis.plot(*path.T, color=plots.GREEN if reached else plots.RED, linewidth=1.2)
            axis.plot(*path[0], "o", color=plots.GREEN if reached else plots.RED, markersize=3)
            axis.plot(*animal.T, color=plots.BLUE, linewidth=1.2)
            axis.plot(*animal[0], "o", color=plots.BLUE, markersize=4)
        axis.set(
            title=f"{name}: {100 * run.reached.mean():.0f} % reached",
            xlabel="x [m]",
            ylabel="z [m]",
            aspect="equal",
        )
    return plots.pixels(figure)


def main() -> None:
    """Train, compare and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("build", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    world, begin = (
        AnimalWorld.load(arguments.build, EnvironmentConfig(episode_s=EPISODE_S, observations=OBSERVATIONS)),
        time.process_time(),
    )
    for name, split in (("training", TRAIN), ("test", TEST)):
        recorded, planned, moments = flight_rates(world, split)
        log(
            f"{name} moments with a person within {CLOSE_M:g} m: {moments}; fled {recorded:.1%}, in plans {planned:.1%}"
        )
    held_out = {
        name: run_episodes(world, policy, arguments.episodes, "test", HELD_OUT_SEED)
        for name, policy in (
            ("straight walk", straight_walk),
            ("random", random_walk(np.random.default_rng(0))),
            ("standing still", stand_still),
        )
    }
    print("| policy | reached, % (seeds) | fled, % | neither, % | seconds to reach |\n|---|---|---|---|---|")
    print("\n".join(table_row(name, [run]) for name, run in held_out.items()), flush=True)
    curves, runs = [], []
    for seed in range(arguments.seeds):
        model, curve = train(world, arguments.steps, seed)
        curves.append(curve)
        runs.append(run_episodes(world, trained_policy(model), arguments.episodes, "test", HELD_OUT_SEED))
        minutes = (time.process_time() - begin) / 60
        log(
            f"seed {seed}: {minutes:.1f} CPU minutes so far; training ended with {np.mean(curve.reached[-LAST_EPISODES:]):.0%}"
        )
        print(table_row(f"learned, {len(runs)} seeds", runs), flush=True)
    if arguments.picture:
        drawn = picture(world, curves, {"learned": runs[0], "straight walk": held_out["straight walk"]})
        cv2.imwrite(
            str(arguments.picture), cv2.cvtColor(drawn, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_WEBP_QUALITY, 80]
        )


if __name__ == "__main__":
    main()
