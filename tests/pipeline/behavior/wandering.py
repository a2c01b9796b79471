"""Synthetic data for behavior tests: an animal that wanders in a walled room with a walking observer."""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pipeline.behavior.config import PlanSamplingConfig, ReplanningConfig
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.model import Architecture, BehaviorNets, Scaling
from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.planning import Sampler, TorchNetworks
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.simulator import Simulator
from pipeline.behavior.trajectories import FUTURE, PAST, RATE_HZ, BehaviorData, Trajectory
from pipeline.geometry import rigid

BONES = 3
REST = rigid.make(
    rigid.rotation_from_vector(np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0.1]])),
    np.array([[0, 0, 0], [0, 0, 0.1], [0, 0.05, -0.1]]),
)
ARCHITECTURE = Architecture(
    bones=BONES,
    body_components=5,
    scene_width=8,
    hidden=16,
    code=8,
    unet_width=8,
    unet_multipliers=(1, 2),
    goal_hidden=16,
    ensemble_size=2,
)


def room() -> FeatureVolume:
    """A room of 4 x 4 m around the origin: floor and four walls, each with its own feature."""
    shape = (44, 12, 44)
    occupancy = np.zeros(shape, np.uint8)
    features = np.zeros((16, *shape), np.float16)
    surfaces = (np.s_[:, :2], np.s_[:2, :], np.s_[-2:, :], np.s_[:, :, :2], np.s_[:, :, -2:])
    for number, surface in enumerate(surfaces):
        occupancy[surface] = 1
        features[(slice(None), *surface)] = 0
        features[(number, *surface)] = 1
    return FeatureVolume(features, occupancy, np.array([-2.2, -0.2, -2.2]), 0.1)


def wander(rng: np.random.Generator, seconds: float = 12.0) -> Trajectory:
    """One recording: smooth random motion inside the room and periodic bone motion."""
    count = round(seconds * RATE_HZ)
    course = gaussian_filter1d(rng.standard_normal((count, 2)), 12, axis=0, mode="wrap")
    course *= 1.4 / np.abs(course).max()
    velocity = np.gradient(course, axis=0)
    yaw = np.unwrap(np.arctan2(velocity[:, 0], velocity[:, 1]))
    upright = np.stack([0 * yaw, yaw, 0 * yaw], axis=-1)
    position = np.stack([course[:, 0], np.full(count, 0.2), course[:, 1]], axis=-1)
    sway = 0.3 * np.sin(np.arange(count)[:, None] * 0.7 + np.arange(BONES))
    turn = rigid.rotation_from_vector(np.stack([sway, 0 * sway, 0 * sway], axis=-1))
    bones = rigid.make(
        turn @ REST[:, :3, :3], REST[:, :3, 3] + 0.02 * np.stack([0 * sway, sway, 0 * sway], axis=-1)
    )
    person = gaussian_filter1d(rng.standard_normal((count, 2)), 15, axis=0, mode="wrap") * 4
    camera = rigid.make(
        np.broadcast_to(np.eye(3), (count, 3, 3)),
        np.stack([person[:, 0], np.full(count, 1.3), person[:, 1]], axis=-1),
    )
    agent = rigid.make(rigid.rotation_from_vector(upright), position)
    return Trajectory(
        np.arange(count) / RATE_HZ, agent, bones.astype(np.float32), camera, np.ones(count, bool)
    )


def wandering(seed: int = 0, videos: int = 3) -> BehaviorData:
    """Several recordings with all their windows; the last is the test recording."""
    rng = np.random.default_rng(seed)
    trajectories = {f"v{number:03d}": wander(rng) for number in range(videos)}
    per_video = len(trajectories["v000"].timestamp_s) - PAST - FUTURE + 1
    video = np.repeat(np.arange(videos), per_video).astype(np.int32)
    start = np.tile(np.arange(per_video), videos).astype(np.int32)
    tested = np.arange(videos) == videos - 1
    return BehaviorData(trajectories, REST.astype(np.float32), video, start, tested, tuple(trajectories))


def scaling() -> Scaling:
    """Return a plausible normalization of goals, paths and bodies."""
    channels = ARCHITECTURE.body_channels
    mean = np.concatenate([[1.0, 0, 0, 0, 1, 0], np.zeros(channels - 6)])
    return Scaling(
        np.array([0.3, 0.01, 0.3]),
        np.array([[0.5, 0.1, 0.5, 1.0]]),
        np.linspace(0.01, 0.3, 56) * np.ones((3, 1)) * [[1], [0.02], [1]],
        mean,
        np.full(channels, 0.05),
    )


def untrained_simulator(goal_steps: int, candidates: int) -> Simulator:
    """Return a simulator of untrained networks in `room`."""
    return Simulator(
        Sampler(TorchNetworks(BehaviorNets(ARCHITECTURE)), Schedule(), scaling()),
        wandering(),
        Scenes.of(room()),
        "yaw",
        sampling=PlanSamplingConfig(goal_steps=goal_steps, sequence_steps=2),
        chaining=ReplanningConfig(candidates=candidates),
    )
