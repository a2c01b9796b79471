"""The animal of a build in MuJoCo, step by step: its bones are the mocap bodies of the export `mjcf`.

A model is the export's `agent.xml`, alone or attached to one with a robot (`mujoco.MjSpec.attach`), which the
animal perceives. Needs the extra `mujoco`.
"""

from importlib import import_module
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.adapters.live_animal import ZUP_FROM_WORLD, LiveAnimal
from pipeline.behavior.simulator import SimulatorState
from pipeline.geometry import rigid

mujoco: Any = import_module("mujoco")  # compiled: type checkers see no functions in it


class MujocoAnimal:
    """Moves the mocap bodies of one animal in a MuJoCo simulation, which it lets pass."""

    def __init__(self, model: Any, data: Any, animal: LiveAnimal, *, observer: str, prefix: str = ""):
        """Take over the bones ``<prefix>bone_00``... of an `MjModel`; the animal perceives ``observer``."""
        self.model, self.data, self.animal = model, data, animal
        self.observer = model.body(observer).id
        count = len(animal.pose.agent_from_bone)
        bodies = [model.body(f"{prefix}bone_{bone:02d}") for bone in range(count)]
        self.mocap = np.array([int(body.mocapid[0]) for body in bodies])
        assert (self.mocap >= 0).all(), "bones are mocap bodies"
        self._put(animal.pose)
        mujoco.mj_forward(model, data)

    @property
    def observer_world(self) -> Float[np.ndarray, "3"]:
        """Where the observer is in the world of the build (+y up), meters."""
        return ZUP_FROM_WORLD[:3, :3].T @ self.data.xpos[self.observer]

    def step(self, steps: int = 1) -> SimulatorState:
        """Let ``steps`` of the model's time steps pass, for the animal and for everything else."""
        for _ in range(steps):
            self._put(self.animal.advance(self.model.opt.timestep, self.observer_world))
            mujoco.mj_step(self.model, self.data)
        return self.animal.pose

    def _put(self, pose: SimulatorState) -> None:
        zup_from_bone = ZUP_FROM_WORLD @ pose.world_from_agent @ pose.agent_from_bone
        self.data.mocap_pos[self.mocap] = zup_from_bone[:, :3, 3]
        self.data.mocap_quat[self.mocap] = rigid.quaternion_from_rotation(zup_from_bone[:, :3, :3])
