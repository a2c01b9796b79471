"""Train PPO to walk up to the animal of a build without making it flee, and compare it with scripted policies.

    python -m benchmarks.approach_policy OUT --simulate --seeds 5 --picture approach.webp
    python -m benchmarks.approach_policy build/cat --seeds 5

Trains from start states in the training recordings, then compares success (the person is within 0.7 m of an
animal that does not flee) in episodes that start in the test recordings, for the learned and for scripted policies.
Whether it flees is judged from where it goes (`benchmarks.approaches`); only rewards read plans.
With `--simulate`, OUT is made first: an hour of the built-in cat's life in 24 homes and the model trained on it
(`benchmarks.approach_animal`); then all policies also meet the true cat in the same episodes. Also reports how often
the recorded animal fled from a nearby person, and how often sampled plans from the same moments do. Needs the extra
`rl`; one thread.
"""

import time
from dataclasses import replace
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from benchmarks import command_lines
from benchmarks.approach_animal import TrueWorld, simulated_build
from benchmarks.approaches import (
    OBSERVATIONS,
    Episodes,
    Policy,
    approach_at,
    facing,
    run_episodes,
    stand_still,
    walk_to,
)
from pipeline.behavior.trajectories import TEST, TRAIN
from pipeline.core.progress import log
from pipeline.data import plots
from pipeline.environments.config import EnvironmentConfig
from pipeline.environments.spaces import person_observation
from pipeline.environments.stable_baselines import PersonStableVecEnv
from pipeline.environments.world import CLOSE_M, AnimalWorld
from pipeline.metrics.flight import flees

ENVIRONMENTS = 64
EPISODE_S = 20.0
HELD_FRAMES = 4
"""Frames for which the learned policy holds an action: decisions at 2.5 Hz explore farther than at 10 Hz."""
PPO_SETTINGS = {
    "n_steps": 8, "batch_size": 256, "n_epochs": 8, "learning_rate": 1e-3, "gamma": 0.99, "gae_lambda": 0.95,
    "policy_kwargs": {"log_std_init": -1.3, "net_arch": [64, 64]},
}  # fmt: skip
"""Usual values for small batches; a discount of 0.99 per decision of 0.4 s is a horizon of 40 s. Observations are
normalized, and rewards by the running standard deviation of the returns."""
TRAINING_SAMPLER = {"sequence_steps": 3, "candidates": 1}
"""Half the denoising steps of paths and bodies, and one plan, for training alone: tests use the defaults."""
SLOW_M_S = 0.2
"""Speed of a person who does not startle."""
RESTING_M_S = 0.15
"""Speed below which the animal rests."""
PLANS = 8
"""Plans drawn at every moment with a person near; with one, the rate of flights changes by 2 points by chance."""
LAST_EPISODES = 300
"""Episodes at the end of training whose success is printed."""
DRAWN_EPISODES = 6
"""Episodes whose paths are drawn."""


def wait_then_walk(observation: dict[str, np.ndarray]) -> Float[np.ndarray, "person 3"]:
    """Stand while the animal moves, and walk to it slowly while it rests."""
    rests = np.linalg.norm(observation["animal"][:, 5:7], axis=1) < RESTING_M_S
    return approach_at(SLOW_M_S)(observation) * rests[:, None]


def random_walk(rng: np.random.Generator) -> Policy:
    """Return a policy that draws every action independently."""
    return lambda observation: rng.uniform(-1, 1, (len(observation["animal"]), 3))


class HeldActionsEnv(PersonStableVecEnv):
    """Holds how persons walk for `HELD_FRAMES` frames, while they face the animal.

    Persons whose episode ended meanwhile stand in the next one.
    """

    def step_wait(self):
        """Advance all, and return summed rewards and the first end of each."""
        total, over = np.zeros(self.num_envs, np.float32), np.zeros(self.num_envs, bool)
        observation, infos = person_observation(self.world), [{} for _ in over]
        for _ in range(HELD_FRAMES):
            walk = np.where(over[:, None], 0.0, self.actions[:, :2])
            self.actions = np.column_stack([walk, facing(observation)])
            observation, reward, ended, found = super().step_wait()
            total += np.where(over, 0.0, reward)
            infos = [old if done else new for old, new, done in zip(infos, found, over, strict=True)]
            over |= ended
        return observation, total, over, infos


def trained_policy(model: PPO, env: VecNormalize) -> Policy:
    """Return the mean action of a trained policy, each held for `HELD_FRAMES` calls."""
    calls, walk = count(), np.zeros((0, 2))

    def policy(observation: dict[str, np.ndarray]) -> Float[np.ndarray, "person 3"]:
        nonlocal walk
        if next(calls) % HELD_FRAMES == 0:
            seen = env.normalize_obs({name: value.copy() for name, value in observation.items()})
            walk = model.predict(seen, deterministic=True)[0][:, :2]
        return np.column_stack([walk, facing(observation)])

    return policy


class OutcomeRecorder(BaseCallback):
    """Records the outcome of every training episode."""

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[int] = []
        self.reached: list[bool] = []

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "reached" in info:
                self.steps.append(self.num_timesteps * HELD_FRAMES)
                self.reached.append(info["reached"])
        return True


def train(world: AnimalWorld, steps: int, seed: int) -> tuple[Policy, OutcomeRecorder]:
    """Train one policy for this many steps of 0.1 s, from a slow walk on: from standing, it learns to stay away."""
    env = VecNormalize(HeldActionsEnv(world, ENVIRONMENTS), gamma=PPO_SETTINGS["gamma"])
    curve = OutcomeRecorder()
    model = PPO("MultiInputPolicy", env, seed=seed, device="cpu", **PPO_SETTINGS)
    model.policy.get_parameter("action_net.bias").data[0] = SLOW_M_S / world.config.speed_m_s
    model.learn(steps // HELD_FRAMES, callback=curve)
    return trained_policy(model, env), curve


def flight_rates(world: AnimalWorld, split: int) -> tuple[float, float, int]:
    """Return the flight rates of the recorded animal and of sampled plans near a person (within `CLOSE_M`), and
    the number of moments.
    """
    windows = world.habitat.data.indices(split)
    context, future = world.habitat.data.windows(windows)
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
    """Return one row of a table: rates over all episodes, and their ranges over seeds."""
    reached = [100 * run.reached.mean() for run in runs]
    fled = [100 * run.fled.mean() for run in runs]
    seconds = np.concatenate([run.seconds[run.reached] for run in runs])
    ranges = [
        f"{np.mean(each):.0f}" + (f" ({min(each):.0f} to {max(each):.0f})" if len(runs) > 1 else "")
        for each in (reached, fled)
    ]
    median = f"{np.median(seconds):.1f}" if len(seconds) else "-"
    neither = max(100 - np.mean(reached) - np.mean(fled), 0.0)
    return f"| {name} | {' | '.join(ranges)} | {neither:.0f} | {median} |"


def picture(world: AnimalWorld, curves: list[OutcomeRecorder], runs: dict[str, Episodes]) -> np.ndarray:
    """Plot success over training, and the paths of the first episodes of a scene in top view."""
    figure, axes = plots.panels(1, 1 + len(runs), width_in=4 * (1 + len(runs)), height_in=3.6)
    for curve in curves:
        width = max(len(curve.reached) // 12, 1)
        mean = np.convolve(curve.reached, np.ones(width) / width, "valid")
        axes[0, 0].plot(curve.steps[width - 1 :], 100 * mean, linewidth=1)
    axes[0, 0].set(
        title="training: reached without flight", xlabel="steps", ylabel="% of episodes", ylim=(0, 100)
    )
    scene = int(next(iter(runs.values())).scene[0])
    floor = world.floors[scene]
    for axis, (name, run) in zip(axes[0, 1:], runs.items(), strict=True):
        plots.floor_plan(axis, floor.blocked.astype(float), floor.corner, floor.cell_m)
        for row in np.flatnonzero(run.scene == scene)[:DRAWN_EPISODES]:
            color = plots.GREEN if run.reached[row] else plots.RED if run.fled[row] else plots.GRAY
            person, animal = run.person_paths[row], run.animal_paths[row]
            axis.plot(*person.T, color=color, linewidth=1.2)
            axis.plot(*person[0], "o", color=color, markersize=3)
            axis.plot(*animal.T, color=plots.BLUE, linewidth=1.2)
            axis.plot(*animal[0], "o", color=plots.BLUE, markersize=4)
        title = f"{name}: {100 * run.reached.mean():.0f} % reached"
        axis.set(title=title, xlabel="x [m]", ylabel="z [m]", aspect="equal")
    return plots.pixels(figure)


def main() -> None:
    """Train, compare and print the tables."""
    parser = command_lines.described(__doc__)
    parser.add_argument("build", type=Path)
    parser.add_argument(
        "--simulate", action="store_true", help="make the build first; also meet the true cat"
    )
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=32_000)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    begin = time.process_time()
    config = EnvironmentConfig(episode_s=EPISODE_S, observations=OBSERVATIONS)
    if arguments.simulate:
        simulated_build(arguments.build)
    world = AnimalWorld.load(arguments.build, config)
    learned_in = AnimalWorld.load(arguments.build, replace(config, **TRAINING_SAMPLER))
    tested = {"simulated": world} | (
        {"true": TrueWorld.of(arguments.build, config)} if arguments.simulate else {}
    )
    for name, split in () if arguments.simulate else (("training", TRAIN), ("test", TEST)):
        recorded, planned, moments = flight_rates(world, split)
        log(
            f"{name} moments with a person within {CLOSE_M:g} m: {moments}; fled {recorded:.1%}, in plans {planned:.1%}"
        )

    def test(policy: Policy) -> dict[str, Episodes]:
        each = tested.items()
        return {name: run_episodes(there, policy, arguments.episodes) for name, there in each}

    print("| animal, policy | reached, % | fled, % | neither, % | seconds to reach |\n|---|---|---|---|---|")
    scripted = {
        "straight walk": walk_to,
        "slow walk": approach_at(SLOW_M_S),
        "wait, then walk slowly": wait_then_walk,
        "random": random_walk(np.random.default_rng(0)),
        "standing still": stand_still,
    }
    held_out = {policy_name: test(policy) for policy_name, policy in scripted.items()}
    for policy_name, found in held_out.items():
        for name, run in found.items():
            print(table_row(f"{name}, {policy_name}", [run]), flush=True)
    curves, learned = [], []
    for seed in range(arguments.seeds):
        policy, curve = train(learned_in, arguments.steps, seed)
        curves.append(curve)
        learned.append(test(policy))
        minutes = (time.process_time() - begin) / 60
        log(
            f"seed {seed}: {minutes:.1f} CPU minutes so far; training ended with {np.mean(curve.reached[-LAST_EPISODES:]):.0%}"
        )
        for name in tested:
            print(
                table_row(f"{name}, learned, {len(learned)} seeds", [run[name] for run in learned]),
                flush=True,
            )
        if arguments.picture:
            shown = {f"{name}, learned": learned[0][name] for name in tested}
            shown |= {f"{name}, straight walk": held_out["straight walk"][name] for name in list(tested)[-1:]}
            drawn = cv2.cvtColor(picture(world, curves, shown), cv2.COLOR_RGB2BGR)
            cv2.imwrite(str(arguments.picture), drawn, [cv2.IMWRITE_WEBP_QUALITY, 80])


if __name__ == "__main__":
    main()
