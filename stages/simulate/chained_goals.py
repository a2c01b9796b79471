"""Sub-goals for minutes of motion from the behavior model: each is sampled where the last plan ended."""

import numpy as np

from pipeline.behavior.simulator import Simulator
from pipeline.behavior.trajectories import RATE_HZ
from pipeline.geometry import rigid
from pipeline.longterm.subgoals import Subgoal
from stages.simulate.observers import Observer


def chained_goals(simulator: Simulator, observer: Observer, count: int, seed: int) -> list[Subgoal]:
    """Return the start and ``count`` goals, one per plan; the simulator must play each plan to its end."""
    chaining = simulator.animals.chaining
    assert np.isinf(chaining.observer_motion_ratio) and not chaining.blend_frames, chaining
    state = simulator.reset(seed)
    frames = simulator.animals.plan_frames
    found = [Subgoal(state.world_from_agent[:3, 3], float(rigid.yaw(state.world_from_agent)), 0.0)]
    for number in range(1, count + 1):
        found.append(Subgoal(np.asarray(state.goal_world), None, number * frames / RATE_HZ))
        for _ in range(frames + (number == 1)):  # the step after the last one of a plan asks for the next
            state = simulator.step(observer(state.time_s, state.world_from_agent[:3, 3]))
    return found
