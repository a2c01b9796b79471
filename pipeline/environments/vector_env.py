"""Vectorized environment for Gymnasium; animals plan in batches."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space

from pipeline.behavior.trajectories import RATE_HZ
from pipeline.environments import spaces
from pipeline.environments.world import AnimalWorld, checked


class PersonVectorEnv(gymnasium.vector.VectorEnv):
    """`PersonEnv` ``num_envs`` times in one process; ended episodes begin anew in the next step."""

    metadata = {  # noqa: RUF012
        "render_modes": [],
        "render_fps": RATE_HZ,
        "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP,
    }

    def __init__(self, build: str | Path | AnimalWorld, num_envs: int = 1, **opening: Any):
        """Open a build (`build/<agent>`); ``opening`` is what `AnimalWorld.opened` takes."""
        self.world = AnimalWorld.opened(build, **opening)
        self.config, self.num_envs, self.render_mode = self.world.config, num_envs, None
        self.single_observation_space = spaces.person_observation_space(self.world)
        self.single_action_space = spaces.person_action_space(self.world)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None):
        """Begin all episodes; one seed (of a list, its first) determines all of them."""
        super().reset(seed=seed[0] if isinstance(seed, list) else seed)
        split = (options or {}).get("split", "train")
        self.world.begin(self.num_envs, self.np_random, split)
        self.split = split
        self.frame, self.ended = np.zeros(self.num_envs, int), np.zeros(self.num_envs, bool)
        info = {name: getattr(self.world, name) for name in ("distance_m", "share_known", "home")}
        return spaces.person_observation(self.world), info

    def step(self, actions: Any):
        """Let 0.1 s pass everywhere (actions: person x command); where an episode ended, begin another."""
        spaces.require_reset(self)
        again = np.flatnonzero(self.ended)
        numbers = checked(actions, (self.num_envs, self.world.action_size))
        outcome = self.world.step(np.where(self.ended[:, None], 0.0, numbers))
        if len(again):
            self.world.restart(again, self.split)
        self.frame = np.where(self.ended, 0, self.frame + 1)
        lived, (reward, over, late) = ~self.ended, self.world.judge(outcome, self.frame)
        terminated, truncated, reward = lived & over, lived & late, np.where(lived, reward, 0.0)
        self.ended = terminated | truncated
        info = {
            "distance_m": self.world.distance_m,
            "reached": lived & outcome.reached,
            "flees": lived & outcome.flees,
            "plans_per_step": np.full(self.num_envs, self.world.plans_per_step),
            "home": self.world.home,
        }
        return spaces.person_observation(self.world), reward, terminated, truncated, info
