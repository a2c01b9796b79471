"""Vectorized environment for Stable-Baselines3 (extra `rl`).

It resets a finished episode in the same step, Gymnasium's vector interface in the next one.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from stable_baselines3.common.vec_env import VecEnv

from pipeline.environments import spaces
from pipeline.environments.world import AnimalWorld


class PersonStableVecEnv(VecEnv):
    """`PersonEnv` ``num_envs`` times in one process, as `stable_baselines3` wants it.

    `reset_infos` holds `home` and `share_known`, each episode's last `info` `reached`, `flees`,
    `terminal_observation` and `TimeLimit.truncated`.
    """

    def __init__(
        self, build: str | Path | AnimalWorld, num_envs: int, *, split: str = "train", **opening: Any
    ):
        """Open a build (`build/<agent>`) by what `AnimalWorld.opened` takes; episodes begin at moments of
        ``split``, train or test.
        """
        self.world = AnimalWorld.opened(build, **opening)
        self.config, self.split, self.render_mode = self.world.config, split, None
        seen, done = spaces.person_observation_space(self.world), spaces.person_action_space(self.world)
        super().__init__(num_envs, seen, done)
        self.rng = np.random.default_rng()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Let one seed decide all episodes from the next `reset` on."""
        self.rng = np.random.default_rng(seed)
        return [seed] * self.num_envs

    def reset(self) -> dict[str, Float[np.ndarray, "person ..."]]:
        """Begin all episodes."""
        split = self._options[0].get("split", self.split)
        self._reset_options()
        self.world.begin(self.num_envs, self.rng, split)
        self.frame, self.split = np.zeros(self.num_envs, int), split
        self._inform()
        return spaces.person_observation(self.world)

    def step_async(self, actions: Any) -> None:
        """Keep the actions (person x command) for `step_wait`."""
        self.actions = actions

    def step_wait(self):
        """Let 0.1 s pass everywhere and begin ended episodes anew."""
        spaces.require_reset(self)
        outcome = self.world.step(self.actions)
        self.frame += 1
        reward, over, late = self.world.judge(outcome, self.frame)
        late &= ~over
        observation = spaces.person_observation(self.world)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        ended = np.flatnonzero(over | late)
        for row in ended:
            infos[row] = {
                "reached": bool(outcome.reached[row]),
                "flees": bool(outcome.flees[row]),
                "TimeLimit.truncated": bool(late[row]),
                "terminal_observation": {name: value[row] for name, value in observation.items()},
            }
        if len(ended):
            self.world.restart(ended, self.split)
            self.frame[ended] = 0
            self._inform()
            observation = spaces.person_observation(self.world)
        return observation, reward.astype(np.float32), over | late, infos

    def _inform(self) -> None:
        """Set `reset_infos` to the home of each episode and how much of it looks known."""
        each = zip(self.world.home.tolist(), self.world.share_known.tolist(), strict=True)
        self.reset_infos = [{"home": home, "share_known": known} for home, known in each]

    def close(self) -> None:
        """Nothing to close."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute, which all of the environments share."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of all."""
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *arguments: Any, indices: Any = None, **named: Any) -> list[Any]:
        """Call a method, once for all."""
        return [getattr(self, method_name)(*arguments, **named)] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return that no environment is wrapped."""
        return [False] * len(list(self._get_indices(indices)))
