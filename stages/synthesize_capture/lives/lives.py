"""One session of a life as a table of motion at 10 Hz, with the home around it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.behavior.perception import FeatureVolume
from pipeline.data import npz
from stages.synthesize_capture import camera_motion, gait, session
from stages.synthesize_capture.animal import BONES, HEADS
from stages.synthesize_capture.observer import AT_HOME
from stages.synthesize_capture.room import Room
from stages.synthesize_capture.voxels import volume_of

RATE_HZ = 10.0
APART_S = 5.0
"""Between two takes of a session, so that no window spans them."""


@dataclass(frozen=True)
class SimulatedLife:
    """What animal and person did in a home."""

    timestamp_s: Float[np.ndarray, "frame"]
    world_from_agent: Float[np.ndarray, "frame 4 4"]
    agent_from_bone: Float[np.ndarray, "frame bone 4 4"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    volume: FeatureVolume
    reason: np.ndarray
    """Index into `policy.REASONS`, per frame."""


def lived(home: Room, rng: np.random.Generator, duration_s: float, takes: int = 1) -> SimulatedLife:
    """Let an animal and a person live in a home, in several takes, each begun anew from anywhere."""
    played = [_take(home, rng, duration_s / takes) for _ in range(takes)]
    begun_s = np.arange(takes) * (duration_s / takes + APART_S)
    time, agent, bones, camera, reason = (np.concatenate(column) for column in zip(*played, strict=True))
    timestamp_s = time + np.repeat(begun_s, [len(part[0]) for part in played])
    return SimulatedLife(timestamp_s, agent, bones, camera, volume_of(home), reason)


def _take(home: Room, rng: np.random.Generator, duration_s: float) -> tuple[np.ndarray, ...]:
    lived_session = session.simulate_session(home, rng, duration_s, AT_HOME)
    timestamp_s = np.arange(round(duration_s * RATE_HZ)) / RATE_HZ
    sample = np.round(timestamp_s / session.STEP_S).astype(int)
    motion = gait.poses(lived_session.animal, timestamp_s)
    camera = camera_motion.filming(lived_session, rng)[sample]
    return timestamp_s, motion.world_from_agent, motion.agent_from_bone, camera, lived_session.reason[sample]


def rest() -> Float[np.ndarray, "bone 4 4"]:
    """Return ``agent_from_bone`` of the animal at rest: level bones at their heads."""
    bones = np.tile(np.eye(4, dtype=np.float32), (len(BONES), 1, 1))
    bones[:, :3, 3] = HEADS
    return bones


def write(path: Path, life: SimulatedLife) -> None:
    """Write a recording that `read_trajectories` takes."""
    volume = {f"volume/{name}": value for name, value in vars(life.volume).items()}
    npz.save(
        path,
        compress=True,
        timestamp_s=life.timestamp_s,
        world_from_agent=life.world_from_agent,
        agent_from_bone=life.agent_from_bone.astype(np.float32),
        world_from_camera=life.world_from_camera,
        agent_from_bone_rest=rest(),
        **volume,
    )
