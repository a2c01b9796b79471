"""A rollout of the simulator as arrays, and as the files of a take."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.behavior.simulator import Simulator, SimulatorState
from pipeline.behavior.trajectories import RATE_HZ
from pipeline.data import npz
from pipeline.geometry import rigid
from stages.simulate.observers import Observer

CSV_COLUMNS = "time_s,x,y,z,qw,qx,qy,qz,speed_m_s,observer_x,observer_y,observer_z,distance_m"


@dataclass(frozen=True)
class Take:
    """What happened in a rollout."""

    timestamp_s: Float[np.ndarray, "frame"]
    world_from_agent: Float[np.ndarray, "frame 4 4"]
    agent_from_bone: Float[np.ndarray, "frame bone 4 4"]
    observer_world: Float[np.ndarray, "frame 3"]
    goal_world: Float[np.ndarray, "frame 3"]
    blocked: Float[np.ndarray, "frame"]
    """share of the current plan's frames in voxels that are not allowed"""


def rollout(simulator: Simulator, observer: Observer, *, seconds: float, seed: int) -> Take:
    """Let the animal live for some seconds beside an observer."""
    state = simulator.reset(seed)
    states, seen = [state], [observer(0.0, state.world_from_agent[:3, 3])]
    for _ in range(round(seconds * RATE_HZ)):
        position = observer(state.time_s, state.world_from_agent[:3, 3])
        state = simulator.step(position)
        states.append(state)
        seen.append(position)
    return take_of(states, seen)


def take_of(states: list[SimulatorState], seen: list[Float[np.ndarray, "3"]]) -> Take:
    """Gather states and the observer's positions."""
    columns = {
        name: np.array([getattr(state, name) for state in states])
        for name in ("time_s", "world_from_agent", "agent_from_bone", "goal_world", "blocked")
    }
    bones = columns.pop("agent_from_bone").astype(np.float32)
    return Take(columns.pop("time_s"), agent_from_bone=bones, observer_world=np.array(seen), **columns)


def write_take(folder: Path, take: Take) -> None:
    """Write ``take.npz`` and ``take.csv`` (a row per frame: position, quaternion, speed, distance)."""
    npz.save(folder / "take.npz", **vars(take))
    position = take.world_from_agent[:, :3, 3]
    quaternion = rigid.quaternion_from_rotation(take.world_from_agent[:, :3, :3])
    moved = np.gradient(position, axis=0) if len(position) > 1 else np.zeros((1, 3))
    speed = RATE_HZ * np.linalg.norm(moved, axis=1)
    distance = np.linalg.norm((take.observer_world - position)[:, [0, 2]], axis=1)
    rows = np.column_stack([take.timestamp_s, position, quaternion, speed, take.observer_world, distance])
    with open(folder / "take.csv", "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(CSV_COLUMNS.split(","))
        writer.writerows([f"{value:.5f}" for value in row] for row in rows)
