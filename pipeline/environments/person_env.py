"""Gymnasium environment of one person, or robot, and one animal."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from pipeline.behavior.trajectories import RATE_HZ
from pipeline.environments import spaces
from pipeline.environments.rendering import PictureWindow, bird_view, known_mode
from pipeline.environments.world import AnimalWorld


class PersonEnv(gymnasium.Env):
    """The agent is a person or a robot, the animal of a build is the world; a step is 0.1 s.

    `reset(options={"split": "test"})` begins at windows of the test recording. `info` holds `distance_m` and
    `home`, of `reset` also `share_known`, of `step` `reached`, `flees` and `plans_per_step`.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": RATE_HZ}  # noqa: RUF012

    def __init__(self, build: str | Path | AnimalWorld, *, render_mode: str | None = None, **opening: Any):
        """Open a build (`build/<agent>`); ``opening`` is what `AnimalWorld.opened` takes."""
        self.world = AnimalWorld.opened(build, **opening)
        self.config, self.render_mode = self.world.config, known_mode(render_mode, self.metadata)
        self.observation_space = spaces.person_observation_space(self.world)
        self.action_space = spaces.person_action_space(self.world)
        self.window: PictureWindow | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin at a recorded moment, the person a few meters off."""
        super().reset(seed=seed)
        self.world.begin(1, self.np_random, (options or {}).get("split", "train"))
        self.frame = 0
        self._show()
        about = "distance_m", "share_known", "home"
        return self._observation(), {name: getattr(self.world, name)[0].item() for name in about}

    def step(self, action: Any):
        """Let 0.1 s pass; an action (2 or 3 numbers in -1..1) is a part of the highest speeds."""
        spaces.require_reset(self)
        outcome = self.world.step([action])
        self.frame += 1
        reward, over, late = self.world.judge(outcome, self.frame)
        self._show()
        info = {
            "distance_m": float(outcome.distance_m[0]),
            "reached": bool(outcome.reached[0]),
            "flees": bool(outcome.flees[0]),
            "plans_per_step": self.world.plans_per_step,
            "home": int(self.world.home[0]),
        }
        return self._observation(), float(reward[0]), bool(over[0]), bool(late), info

    def render(self):
        """Return a picture from above (`rgb_array`)."""
        spaces.require_reset(self)
        return bird_view(self.world, 0) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window."""
        if self.window is not None:
            self.window.close()
            self.window = None

    def _observation(self) -> dict[str, np.ndarray]:
        return {name: value[0] for name, value in spaces.person_observation(self.world).items()}

    def _show(self) -> None:
        if self.render_mode == "human":
            self.window = self.window or PictureWindow()
            self.window.show(bird_view(self.world, 0))
