"""Person and animal both act, for PettingZoo: the animal's action is a goal that it plans its way to."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from pettingzoo import ParallelEnv

from pipeline.behavior.trajectories import RATE_HZ
from pipeline.environments.floor import to_local, to_world
from pipeline.environments.rendering import bird_view, known_mode
from pipeline.environments.spaces import (
    FAR,
    person_action_space,
    person_observation,
    person_observation_space,
)
from pipeline.environments.world import AnimalWorld, checked

PERSON, ANIMAL = "person", "animal"
GOAL_M = 3.0
"""Distance of the goal along each axis that an action of 1 stands for, meters."""


class PersonAnimalEnv(ParallelEnv):
    """The person walks, the animal is steered: its action is a goal in its own frame, left and
    ahead.

    The behavior model plans path and body to that goal, as it does to its own. The animal's reward is the
    person's with the opposite sign.
    """

    metadata = {  # noqa: RUF012
        "name": "agent_to_sim_v0",
        "render_modes": ["rgb_array"],
        "render_fps": RATE_HZ,
    }

    def __init__(self, build: str | Path | AnimalWorld, *, render_mode: str | None = None, **opening: Any):
        """Open a build (`build/<agent>`); ``opening`` is what `AnimalWorld.opened` takes."""
        self.world = AnimalWorld.opened(build, **opening)
        self.config, self.render_mode = self.world.config, known_mode(render_mode, self.metadata)
        self.possible_agents = [PERSON, ANIMAL]
        self.agents: list[str] = []
        self.observation_spaces = {
            PERSON: person_observation_space(self.config.observations),
            ANIMAL: gymnasium.spaces.Box(-FAR, FAR, (4,), np.float32),
        }
        self.action_spaces = {
            PERSON: person_action_space(self.world),
            ANIMAL: gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32),
        }

    def observation_space(self, agent: str) -> gymnasium.Space:
        """Return what an agent observes."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space:
        """Return what an agent can do."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin at a recorded moment, the person a few meters off."""
        if seed is not None or not hasattr(self, "rng"):
            self.rng = np.random.default_rng(seed)
        self.agents, self.frame = list(self.possible_agents), 0
        self.world.begin(1, self.rng, (options or {}).get("split", "train"))
        return self._observations(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]):
        """Let 0.1 s pass; actions (2 or 3 in -1..1) are parts of highest speeds, or of the farthest goal."""
        root = self.world.animals.past[-1].root[0, 0]
        if ANIMAL in actions:
            wish = checked([actions[ANIMAL]], (1, 2)).clip(-1, 1)
            goal = to_world(GOAL_M * wish, self._animal_heading())[0]
            self.world.animals.command((root[:3, 3] + [goal[0], 0.0, goal[1]])[None])
        outcome = self.world.step([actions.get(PERSON, ())])
        self.frame += 1
        rewards, ended, out_of_time = self.world.judge(outcome, self.frame)
        reward, over, late, agents = float(rewards[0]), bool(ended[0]), bool(out_of_time), self.agents
        if over or late:
            self.agents = []
        return (
            self._observations(),
            {PERSON: reward, ANIMAL: -reward},
            dict.fromkeys(agents, over),
            dict.fromkeys(agents, late),
            {agent: {"distance_m": float(outcome.distance_m[0])} for agent in agents},
        )

    def render(self):
        """Return a picture from above (`rgb_array`)."""
        return bird_view(self.world, 0) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Nothing to close."""

    def _animal_heading(self) -> np.ndarray:
        ahead = self.world.animals.past[-1].root[:, 0, :3, 2]
        return np.arctan2(ahead[:, 0], ahead[:, 2])

    def _observations(self) -> dict[str, Any]:
        world, heading = self.world, self._animal_heading()
        place = to_local(world.persons.position - world.animal_position[:, [0, 2]], heading)
        velocity = to_local(world.persons.velocity, heading)
        seen = np.concatenate([place, velocity], axis=-1).astype(np.float32).clip(-FAR, FAR)
        person = {name: value[0] for name, value in person_observation(world).items()}
        return {PERSON: person, ANIMAL: seen[0]}
