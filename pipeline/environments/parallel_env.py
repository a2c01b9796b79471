"""Person and animals all act, for PettingZoo: an animal's action is a goal that it plans its way to."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Float
from pettingzoo import ParallelEnv

from pipeline.behavior.simulator import AnimalBatch
from pipeline.behavior.trajectories import RATE_HZ
from pipeline.core.config import refuse_unknown
from pipeline.core.videos import PERSON
from pipeline.environments import spaces
from pipeline.environments.floor import to_local, to_world
from pipeline.environments.rendering import bird_view, known_mode
from pipeline.environments.world import ANIMAL_NUMBERS, AnimalWorld, checked, others_seen

GOAL_M = 3.0
"""Distance of the goal along each axis that an action of 1 stands for, meters."""


class PersonAnimalEnv(ParallelEnv):
    """The person walks, the animals are steered: an action is a goal in an animal's own frame, left and
    ahead.

    Agents are the person and each animal by its name, `animal` in builds of one. The behavior model plans
    path and body to a goal, as it does to its own; None lets an animal choose its own again, and one that is
    left out of the actions keeps what it was last given. The reward of the animal that the person meets is
    the person's with the opposite sign, that of other animals is 0.
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
        self.possible_agents = [PERSON, *self.world.batches]
        self.agents: list[str] = []
        numbers = 4 + (len(self.world.names) - 1) * (1 + ANIMAL_NUMBERS)
        box, seen, done = gymnasium.spaces.Box, spaces.person_observation_space, spaces.person_action_space
        self.observation_spaces: dict[str, gymnasium.Space] = {PERSON: seen(self.world)}
        self.action_spaces: dict[str, gymnasium.Space] = {PERSON: done(self.world)}
        for name in self.world.batches:
            self.observation_spaces[name] = box(-spaces.FAR, spaces.FAR, (numbers,), np.float32)
            self.action_spaces[name] = box(-1.0, 1.0, (2,), np.float32)

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
        self.world.begin(1, self.rng, (options or {}).get("split", "train"))
        self.agents, self.frame = list(self.possible_agents), 0
        known = {name: float(self.world.share_known_of(name)[0]) for name in self.world.batches}
        known[PERSON] = known[self.world.target]
        return self._observations(), {agent: {"share_known": known[agent]} for agent in self.agents}

    def step(self, actions: Mapping[str, Any]):
        """Let 0.1 s pass; actions (2 or 3 in -1..1) are parts of highest speeds, or of the farthest goal."""
        spaces.require_reset(self)
        refuse_unknown(actions, self.agents, where="step: actions", kind="agent")
        for name, batch in self.world.batches.items():
            if name in actions:
                batch.command(self._goal_world(batch, actions[name]))
        outcome = self.world.step([actions.get(PERSON, ())])
        self.frame += 1
        rewards, ended, out_of_time = self.world.judge(outcome, self.frame)
        reward, over, late, agents = float(rewards[0]), bool(ended[0]), bool(out_of_time), self.agents
        if over or late:
            self.agents = []
        earned = dict.fromkeys(agents, 0.0) | {PERSON: reward, self.world.target: -reward}
        away = {name: float(self.world.distance_of_m(name)[0]) for name in self.world.batches}
        away[PERSON] = away[self.world.target]
        return (
            self._observations(),
            earned,
            dict.fromkeys(agents, over),
            dict.fromkeys(agents, late),
            {agent: {"distance_m": away[agent]} for agent in agents},
        )

    def render(self):
        """Return a picture from above (`rgb_array`)."""
        spaces.require_reset(self)
        return bird_view(self.world, 0) if self.render_mode == "rgb_array" else None

    @staticmethod
    def _goal_world(batch: AnimalBatch, action: Any) -> Float[np.ndarray, "1 3"]:
        """Return the goal that an action (left, ahead) stands for, meters; NaN for none."""
        if action is None:
            return np.full((1, 3), np.nan)
        wish = checked([action], (1, 2)).clip(-1, 1)
        goal = to_world(GOAL_M * wish, heading_of(batch))[0]
        return batch.past[-1].root[:, 0, :3, 3] + [goal[0], 0.0, goal[1]]

    def _observations(self) -> dict[str, Any]:
        world, seen = self.world, {}
        for name, batch in world.batches.items():
            place, heading = batch.past[-1].root[:, 0, [0, 2], 3], heading_of(batch)
            offset = to_local(world.persons.position - place, heading)
            velocity = to_local(world.persons.velocity, heading)
            others = others_seen(world, name, place, heading).reshape(1, -1)
            numbers = np.concatenate([offset, velocity, others], axis=-1)
            seen[name] = numbers.astype(np.float32).clip(-spaces.FAR, spaces.FAR)[0]
        return {PERSON: {name: value[0] for name, value in spaces.person_observation(world).items()}} | seen


def heading_of(batch: AnimalBatch) -> Float[np.ndarray, "animal"]:
    """Return where animals look, radians about world +y, 0 along +z."""
    ahead = batch.past[-1].root[:, 0, :3, 2]
    return np.arctan2(ahead[:, 0], ahead[:, 2])
