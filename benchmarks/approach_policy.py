"""A policy that walks up to the animal of a build without making it flee, learned by PPO in its environment.

    python -m benchmarks.approach_policy build/cat --seeds 5 --steps 200000 --picture approach.webp

Trains on moments of the training recordings, then compares success (the person is within 0.7 m of an animal
that does not flee) in episodes that begin at moments of the test recording: learned, straight walk, random,
standing still. Beside it stands how often the recorded animal got away from a person nearby, and how often it
does in plans from the same moments. Needs the extra `rl`; one thread.
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
"""Five times as long as the longest straight walk takes."""
PPO_SETTINGS = {
    "n_steps": 16, "batch_size": 256, "n_epochs": 6, "learning_rate": 1e-3, "gamma": 0.98, "gae_lambda": 0.95,
    "policy_kwargs": {"log_std_init": -0.7, "net_arch": [64, 64]},
}  # fmt: skip
"""Small batches' usual values; a second is ten steps, so that 0.98 looks five seconds ahead. Rewards are divided
by the running spread of their returns, which reach 5, or the value network's gradient drowns the policy's."""
OBSERVED = ("animal", "velocity")
"""The floor plan around the person, 256 numbers, made learning several times as slow."""
Policy = Callable[[dict[str, Float[np.ndarray, "person ..."]]], Float[np.ndarray, "person action"]]
HELD_OUT_SEED = 1000
"""Decides starts and plans of the comparison, the same for all policies."""
LAST = 300
"""Episodes at the end of training whose success is printed."""
SHOWN = 6
"""Episodes whose ways are drawn."""


@dataclass(frozen=True)
class Episodes:
    """How episodes ended, the first end of each."""

    reached: Bool[np.ndarray, "episode"]
    fled: Bool[np.ndarray, "episode"]
    seconds: Float[np.ndarray, "episode"]
    ways: Float[np.ndarray, "episode step 2"]
    """Of the person, world x and z, metres; NaN after the end."""
    animals: Float[np.ndarray, "episode step 2"]


def straight(observation: dict[str, np.ndarray]) -> Float[np.ndarray, "person 3"]:
    """Turn to the animal and walk at it at full speed."""
    left, ahead = observation["animal"][:, 0], observation["animal"][:, 1]
    angle = np.arctan2(left, ahead)
    speed = np.cos(angle).clip(0, 1)
    return np.stack([speed, np.zeros_like(speed), (angle * 5).clip(-1, 1)], axis=-1)


def random_walk(rng: np.random.Generator) -> Policy:
    """Draw every action anew."""
    return lambda observation: rng.uniform(-1, 1, (len(observation["animal"]), 3))


def still(observation: dict[str, np.ndarray]) -> Float[np.ndarray, "person 3"]:
    """Stand and wait."""
    return np.zeros((len(observation["animal"]), 3))


def learned(model: PPO) -> Policy:
    """Return the mean action of a trained policy."""
    return lambda observation: model.predict(observation, deterministic=True)[0]


def played(world: AnimalWorld, policy: Policy, count: int, split: str, seed: int) -> Episodes:
    """Let ``count`` episodes run to their first end, all at once."""
    world.begin(count, np.random.default_rng(seed), split)
    frames = round(world.config.episode_s * RATE_HZ)
    reached, fled, seconds = (
        np.zeros(count, bool),
        np.zeros(count, bool),
        np.full(count, world.config.episode_s),
    )
    ways, animals = np.full((count, frames + 1, 2), np.nan), np.full((count, frames + 1, 2), np.nan)
    for frame in range(frames):
        going = ~(reached | fled)
        ways[going, frame] = world.persons.position[going]
        animals[going, frame] = world.animal_position[going][:, [0, 2]]
        outcome = world.step(policy(person_observation(world)))
        ended = going & (outcome.reached | outcome.flees)
        reached |= going & outcome.reached
        fled |= going & outcome.flees
        seconds[ended] = (frame + 1) / RATE_HZ
        ways[ended, frame + 1] = world.persons.position[ended]
        animals[ended, frame + 1] = world.animal_position[ended][:, [0, 2]]
    return Episodes(reached, fled, seconds, ways, animals)


class Curve(BaseCallback):
    """Keep how the last episodes of training ended."""

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[int] = []
        self.ends: list[bool] = []

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "reached" in info:
                self.steps.append(self.num_timesteps)
                self.ends.append(info["reached"])
        return True


def trained(world: AnimalWorld, steps: int, seed: int) -> tuple[PPO, Curve]:
    """Train one policy."""
    env = VecNormalize(PersonStableVecEnv(world, ENVIRONMENTS), norm_obs=False, gamma=PPO_SETTINGS["gamma"])
    curve = Curve()
    model = PPO("MultiInputPolicy", env, seed=seed, device="cpu", **PPO_SETTINGS)
    model.learn(steps, callback=curve)
    return model, curve


def flights(world: AnimalWorld, split: int) -> tuple[float, float, int]:
    """Return how often the recorded animal, and its plans, got away from a person within `CLOSE_M`, and of
    how many moments.
    """
    windows = world.data.indices(split)
    context, future = world.data.windows(windows)
    now, person = context.world_from_agent[:, -1, :3, 3], context.observer_world[:, -1]
    near = np.linalg.norm((now - person)[:, [0, 2]], axis=1) < CLOSE_M
    if not near.any():
        return np.nan, np.nan, 0
    recorded = flees(future.path_world, now, person)[near]
    world.animals.begin(context[near], np.random.default_rng(0))
    planned = flees(world.animals.plan.root[..., :3, 3], now[near], person[near])
    return float(recorded.mean()), float(planned.mean()), int(near.sum())


def told(name: str, runs: list[Episodes]) -> str:
    """Return one line of the table: shares over all episodes, and the range over seeds."""
    reached = [100 * run.reached.mean() for run in runs]
    fled = [100 * run.fled.mean() for run in runs]
    seconds = np.concatenate([run.seconds[run.reached] for run in runs])
    spread = f" ({min(reached):.0f}-{max(reached):.0f})" if len(runs) > 1 else ""
    median = f"{np.median(seconds):.1f}" if len(seconds) else "-"
    late = 100 - np.mean(reached) - np.mean(fled)
    return f"| {name} | {np.mean(reached):.0f}{spread} | {np.mean(fled):.0f} | {late:.0f} | {median} |"


def picture(world: AnimalWorld, curves: list[Curve], runs: dict[str, Episodes]) -> np.ndarray:
    """Draw success over training, and ways of the first episodes from above."""
    figure, axes = plots.panels(1, 1 + len(runs), width_in=4 * (1 + len(runs)), height_in=3.6)
    for curve in curves:
        width = max(len(curve.ends) // 12, 1)
        mean = np.convolve(curve.ends, np.ones(width) / width, "valid")
        axes[0, 0].plot(curve.steps[width - 1 :], 100 * mean, linewidth=1)
    axes[0, 0].set(
        title="training: reached without flight", xlabel="steps", ylabel="% of episodes", ylim=(0, 100)
    )
    floor = world.floors[0]
    for axis, (name, run) in zip(axes[0, 1:], runs.items(), strict=True):
        plots.floor_plan(axis, floor.blocked.astype(float), floor.corner, floor.cell_m)
        for way, animal, good in zip(run.ways[:SHOWN], run.animals[:SHOWN], run.reached[:SHOWN], strict=True):
            axis.plot(*way.T, color=plots.GREEN if good else plots.RED, linewidth=1.2)
            axis.plot(*way[0], "o", color=plots.GREEN if good else plots.RED, markersize=3)
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
    """Train, compare, print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("build", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--picture", type=Path)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    world, begin = (
        AnimalWorld.load(asked.build, EnvironmentConfig(episode_s=EPISODE_S, observations=OBSERVED)),
        time.process_time(),
    )
    for name, split in (("training", TRAIN), ("test", TEST)):
        recorded, planned, moments = flights(world, split)
        log(
            f"{name} moments with a person within {CLOSE_M:g} m: {moments}; fled {recorded:.1%}, in plans {planned:.1%}"
        )
    held_out = {
        name: played(world, policy, asked.episodes, "test", HELD_OUT_SEED)
        for name, policy in (
            ("straight walk", straight),
            ("random", random_walk(np.random.default_rng(0))),
            ("standing still", still),
        )
    }
    print("| policy | reached, % (seeds) | fled, % | neither, % | seconds to reach |\n|---|---|---|---|---|")
    print("\n".join(told(name, [run]) for name, run in held_out.items()), flush=True)
    curves, runs = [], []
    for seed in range(asked.seeds):
        model, curve = trained(world, asked.steps, seed)
        curves.append(curve)
        runs.append(played(world, learned(model), asked.episodes, "test", HELD_OUT_SEED))
        minutes = (time.process_time() - begin) / 60
        log(
            f"seed {seed}: {minutes:.1f} CPU minutes so far; training ended with {np.mean(curve.ends[-LAST:]):.0%}"
        )
        print(told(f"learned, {len(runs)} seeds", runs), flush=True)
    if asked.picture:
        drawn = picture(world, curves, {"learned": runs[0], "straight walk": held_out["straight walk"]})
        cv2.imwrite(
            str(asked.picture), cv2.cvtColor(drawn, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_WEBP_QUALITY, 80]
        )


if __name__ == "__main__":
    main()
