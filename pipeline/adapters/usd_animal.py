"""The animal of a build on an open USD stage, for Isaac Sim and Omniverse: keys of the export `usd` are
replaced by the pose of now.

Any program with the libraries of `pxr` will do; what lets time pass calls `step`. Needs the extra `usd`, or
Isaac Sim's own Python.
"""

from importlib import import_module
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.adapters.live_animal import LiveAnimal
from pipeline.behavior.simulator import SimulatorState
from pipeline.geometry import rigid

Gf: Any
Usd: Any
UsdSkel: Any
Vt: Any
Gf, Usd, UsdSkel, Vt = (import_module(f"pxr.{name}") for name in ("Gf", "Usd", "UsdSkel", "Vt"))


class UsdAnimal:
    """Writes poses into the `SkelAnimation` of an animal that the export `usd` wrote."""

    def __init__(self, stage: Any, animal: LiveAnimal, *, path: str = "/agent"):
        """Take over the animal at ``path`` of a `Usd.Stage`: one that was opened, or referenced into a scene.

        The stage has meters and +y up, as the export has; in a scene with +z up turn the prim at ``path``.
        """
        self.animal = animal
        self.motion = UsdSkel.Animation(stage.GetPrimAtPath(f"{path}/motion"))
        joints = self.motion.GetJointsAttr().Get()
        assert len(joints) == 1 + len(animal.pose.agent_from_bone), "a root and the bones of this build"
        for attribute in (self.motion.GetTranslationsAttr(), self.motion.GetRotationsAttr()):
            attribute.Clear()
        self._put(animal.pose)

    def step(self, seconds: float, observer_world: Float[np.ndarray, "3"]) -> SimulatorState:
        """Let time pass with the observer's eyes at a place (world of the build, meters)."""
        pose = self.animal.advance(seconds, observer_world)
        self._put(pose)
        return pose

    def _put(self, pose: SimulatorState) -> None:
        joints = np.concatenate([pose.world_from_agent[None], pose.agent_from_bone])
        turns = rigid.quaternion_from_rotation(joints[:, :3, :3])
        places = np.ascontiguousarray(joints[:, :3, 3], np.float32)
        now = Usd.TimeCode.Default()
        self.motion.GetTranslationsAttr().Set(Vt.Vec3fArray.FromNumpy(places), now)
        self.motion.GetRotationsAttr().Set(
            Vt.QuatfArray([Gf.Quatf(*map(float, turn)) for turn in turns]), now
        )
