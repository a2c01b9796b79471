"""One animal for programs with their own clock: robot simulators, game engines, ROS.

`LiveAnimal.open` opens a build; `advance` simulates any time span with the observer at a position and returns
the pose. `pipeline.adapters.mujoco_animal`, `usd_animal` and `ros2_animal` are adapters of it.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.behavior.simulator import Simulator, SimulatorState
from pipeline.behavior.trajectories import RATE_HZ
from pipeline.core import threads
from pipeline.core.errors import InputError
from pipeline.environments.config import EnvironmentConfig
from pipeline.environments.residents import Resident
from pipeline.geometry import rigid

ZUP_FROM_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From the world of a build (+y up) to that of programs with +z up; as in the export `mjcf`."""


class LiveAnimal:
    """An animal that perceives one observer and is asked for its pose at any times that do not go back."""

    def __init__(self, simulator: Simulator, seed: int = 0):
        """``seed`` decides the recorded moment that it begins in, and all its plans."""
        self.simulator = simulator
        self.reset(seed)

    @classmethod
    @threads.single_threaded()  # forked processes hang in PyTorch's threads
    def open(
        cls, build: Path, *, home: Path | None = None, seed: int = 0, device: str = "cpu"
    ) -> "LiveAnimal":
        """Open `build/<agent>`, in the home of another build if given; raises as `Resident.load`."""
        resident = Resident.load(build, homes=() if home is None else (home,), device=device)
        where, how = (resident.habitat.data, resident.habitat.scenes), EnvironmentConfig()
        settings = {"sampling": how.sampling, "chaining": how.chaining}
        return cls(Simulator(resident.sampler, *where, resident.ego, **settings), seed)

    @threads.single_threaded()
    def reset(self, seed: int) -> None:
        """Begin again at time 0."""
        self.time_s = 0.0
        self.before = self.after = self.simulator.reset(seed)

    @property
    def pose(self) -> SimulatorState:
        """The current pose, interpolated between the simulator's adjacent frames."""
        share = np.array([(self.time_s - self.before.time_s) * RATE_HZ])
        frames = self.before, self.after
        tracks = np.stack([[each.world_from_agent, *each.agent_from_bone] for each in frames], axis=1)
        root, *bones = (rigid.interpolate(np.arange(2.0), track, share)[0] for track in tracks)
        now = self.time_s, root, np.stack(bones)
        return SimulatorState(*now, self.after.goal_world, self.after.blocked)

    @threads.single_threaded()
    def advance(self, seconds: float, observer_world: Float[np.ndarray, "3"]) -> SimulatorState:
        """Advance time with the observer's eyes at a position (world, meters) and return the new pose.

        Raises SIM-012 if time or position are not finite, or time is negative.
        """
        place = np.asarray(observer_world, float)
        if place.shape != (3,) or not np.isfinite([seconds, *place]).all() or seconds < 0:
            what = f"cannot let {seconds} s pass with an observer at {place.tolist()}"
            remedy = "give seconds and a position of three finite numbers"
            raise InputError("SIM-012", what, "advance", remedy)
        self.time_s += seconds
        while self.after.time_s < self.time_s - 1e-9:
            self.before, self.after = self.after, self.simulator.step(place)
        return self.pose
