"""Camera paths of the hand-held phone for the walk-through, the turnaround, the filming person and a
bystander.

Every path is a smooth function of time plus the bob of steps, the sway of arms and the tremor of hands.
Cameras are `world_from_camera`, OpenCV axes of a phone held upright.
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from pipeline.geometry import rigid
from stages.synthesize_capture.navigation import PERSON_M, floor_for
from stages.synthesize_capture.room import DEPTH_M, WIDTH_M, Room
from stages.synthesize_capture.session import STEP_S, AnimalCourse, SessionTrajectories, steps

Cameras = Float[np.ndarray, "sample 4 4"]
ARM_M = 0.3
"""Distance of the phone in front of the body."""


def walkthrough(room: Room, rng: np.random.Generator, duration_s: float) -> Cameras:
    """Scan an empty room all around: along the floor, into corners, over furniture."""
    timestamp_s = np.arange(steps(duration_s)) * STEP_S
    share = timestamp_s / timestamp_s[-1]
    floor = floor_for(room.obstacles(), PERSON_M)
    rounds = 2.0 + 0.5 * (duration_s > 30)
    angle = 2 * np.pi * rounds * share + rng.uniform(0, 2 * np.pi)
    # The person films the opposite side of the room, so that near walls do not fill the picture.
    wanted = np.stack([-0.24 * WIDTH_M * np.sin(angle), -0.2 * DEPTH_M * np.cos(angle)], axis=-1)
    wanted *= (0.75 + 0.25 * np.sin(2 * np.pi * 1.3 * share))[:, None]
    position = np.array([floor.nearest(point) for point in wanted[::10]])
    smooth = gaussian_filter1d(position, 2.0, axis=0)
    x, z = (np.interp(timestamp_s, timestamp_s[::10], smooth[:, axis]) for axis in range(2))
    swing = angle + 0.45 * np.sin(2 * np.pi * 4.3 * share)
    down = 0.28 + 0.42 * np.sin(2 * np.pi * (3.2 * rounds) * share)
    eye = np.stack([x, 1.42 + 0.12 * np.sin(2 * np.pi * 2.1 * share), z], axis=-1)
    forward = np.stack([np.sin(swing) * np.cos(down), -np.sin(down), np.cos(swing) * np.cos(down)], axis=-1)
    return _handheld(eye, eye + forward, rng, calm=0.8)


def turnaround(course: AnimalCourse, rng: np.random.Generator) -> Cameras:
    """Circle the animal slightly more than once, 1.0 to 1.4 m away, looking down from varying heights."""
    share = course.timestamp_s / course.timestamp_s[-1]
    angle = rng.uniform(0, 2 * np.pi) + 2 * np.pi * 1.08 * share + 0.05 * np.sin(2 * np.pi * 5 * share)
    radius = 1.12 + 0.12 * np.sin(2 * np.pi * 1.7 * share + 1.0)
    height = 0.82 + 0.22 * np.sin(2 * np.pi * 1.4 * share + 2.0)
    center = course.position + np.array([0.0, 0.2, 0.0])
    eye = center * [1, 0, 1] + np.stack([radius * np.sin(angle), height, radius * np.cos(angle)], axis=-1)
    return _handheld(eye, center + 0.04 * _wander(rng, len(share), 0.6), rng, calm=0.8)


def filming(session: SessionTrajectories, rng: np.random.Generator) -> Cameras:
    """Return the filming phone's path: in front of the chest, aimed at what the person looks at."""
    looks_at, ground = session.observer_looks_at, session.observer_position
    toward = looks_at[:, [0, 2]] - ground
    toward = gaussian_filter1d(toward, 0.15 / STEP_S, axis=0)
    toward /= np.maximum(np.linalg.norm(toward, axis=-1, keepdims=True), 0.2)
    height = rng.uniform(1.28, 1.42) + 0.05 * _wander(rng, len(ground), 2.0)[:, 0]
    ground = ground + ARM_M * toward
    eye = gaussian_filter1d(np.insert(ground, 1, height, axis=1), 0.08 / STEP_S, axis=0)
    return _handheld(_inside(eye), looks_at + 0.10 * _wander(rng, len(ground), 0.9), rng, calm=1.0)


def bystanding(session: SessionTrajectories, room: Room, rng: np.random.Generator) -> Cameras:
    """Return a second phone's path, on the opposite side of the animal from the filming person."""
    floor = floor_for(room.obstacles(), PERSON_M)
    animal = session.animal.position[:, [0, 2]]
    opposite = animal + (animal - session.observer_position)
    centers = floor.centers()
    every = round(1.0 / STEP_S)
    stands = []
    for at, target in zip(animal[::every], opposite[::every], strict=True):
        near = np.maximum(1.3 - np.linalg.norm(centers - at, axis=-1), 0)
        cost = np.linalg.norm(centers - target, axis=-1) + 3 * near
        cost += 0.6 * np.linalg.norm(centers - stands[-1], axis=-1) if stands else 0
        stands.append(centers[np.argmin(cost)])
    slow = gaussian_filter1d(np.array(stands), 1.6, axis=0)
    count = len(animal)
    x, z = (np.interp(np.arange(count), np.arange(len(slow)) * every, slow[:, axis]) for axis in range(2))
    eye = np.stack([x, 1.36 + 0.06 * _wander(rng, count, 2.0)[:, 0], z], axis=-1)
    target = gaussian_filter1d(session.animal.position + np.array([0, 0.25, 0]), 0.35 / STEP_S, axis=0)
    return _handheld(_inside(eye), target + 0.08 * _wander(rng, count, 0.9), rng, calm=0.7)


def _handheld(eye: np.ndarray, target: np.ndarray, rng: np.random.Generator, *, calm: float) -> Cameras:
    """Aim from ``eye`` at ``target`` and add steps, sway and tremor (less for smaller ``calm``)."""
    count = len(eye)
    speed = np.linalg.norm(np.gradient(gaussian_filter1d(eye, 5, axis=0), STEP_S, axis=0), axis=-1)
    walking = gaussian_filter1d(np.clip(speed / 0.8, 0, 1), 6)
    steps = 2 * np.pi * np.cumsum(1.5 + 0.4 * walking) * STEP_S
    eye = eye + 0.008 * calm * _wander(rng, count, 0.5)
    eye[:, 1] += 0.018 * walking * np.sin(steps)
    forward = target - eye
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.maximum(np.linalg.norm(right, axis=-1, keepdims=True), 0.05)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=-1)
    shake = calm * (0.022 * _wander(rng, count, 0.45) + 0.005 * _wander(rng, count, 0.09))
    shake[:, 2] = 0.05 * _wander(rng, count, 1.5)[:, 2]
    shake[:, 0] += 0.010 * walking * np.sin(steps + 0.7)
    shake[:, 1] += 0.008 * walking * np.sin(0.5 * steps)
    return rigid.make(rotation @ rigid.rotation_from_vector(shake), eye)


def _inside(eye: np.ndarray) -> np.ndarray:
    """Clip positions to the room, off the walls."""
    from_wall = np.array([WIDTH_M / 2 - 0.16, 9.0, DEPTH_M / 2 - 0.16])
    return np.clip(eye, -from_wall, from_wall)


def _wander(rng: np.random.Generator, count: int, seconds: float) -> Float[np.ndarray, "sample 3"]:
    """Return smooth noise of unit standard deviation with a correlation time of about ``seconds``."""
    pad = int(4 * seconds / STEP_S) + 1
    noise = gaussian_filter1d(rng.standard_normal((count + 2 * pad, 3)), seconds / STEP_S, axis=0)
    return noise[pad : pad + count] * np.sqrt(2 * np.sqrt(np.pi) * seconds / STEP_S)
