"""Frames vote for the pose of the recording in the world.

`collect` localizes a subset of the frames, `agree` finds the one transform of the whole odometry that most
votes support, `rejection_reason` returns why a recording does not fit.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.core.progress import track
from pipeline.data.clips import Clip, Masks
from pipeline.geometry import rigid, subsampling
from pipeline.localization.localizer import Localizer, PoseHypothesis
from stages.register_videos.config import VoteConfig

MIN_VOTES, MIN_SHARE = 3, 0.25
"""FrameVotes that must agree, and their share of all: two may agree by chance."""
MIN_LOCALIZED = 20
"""Short recordings are localized more often, so that so many frames may vote."""
MAX_PROPOSALS = 400
"""At most so many votes, evenly spaced, propose a transform; all judge it."""
REFIT_ROUNDS = 3
"""The best proposal is fitted to its supporters so often."""


@dataclass(frozen=True)
class FrameVotes:
    """Localized frames."""

    frame: np.ndarray
    """[vote] i8: the frame that voted."""
    answers: list[PoseHypothesis]
    asked: int
    """Frames that were localized, with or without a pose."""
    nearest: PoseHypothesis | None
    """The best pose of all, even improbable: the nearest view of the template."""

    @property
    def world_from_camera(self) -> Float[np.ndarray, "vote 4 4"]:
        """The voted poses."""
        if self.answers:
            return np.stack([answer.map_from_camera for answer in self.answers])
        return np.zeros((0, 4, 4))

    @property
    def probability(self) -> Float[np.ndarray, "vote"]:
        """Probability of each vote."""
        return np.array([answer.probability for answer in self.answers])


@dataclass(frozen=True)
class Agreement:
    """The transform that most votes support."""

    world_from_odometry: Float[np.ndarray, "4 4"]
    supports: Bool[np.ndarray, "vote"]


def none_cast() -> FrameVotes:
    """Return what there is where no frame was asked."""
    return FrameVotes(np.zeros(0, int), [], 0, None)


def collect(clip: Clip, masks: Masks, localizer: Localizer, config: VoteConfig) -> FrameVotes:
    """Localize one frame in so many, with the agent masked out."""
    step = min(config.every_frames, max(len(clip) // MIN_LOCALIZED, 1))
    asked = np.arange(min(step // 2, len(clip) - 1), len(clip), step)
    frames, answers, nearest = [], [], None
    for frame in track(asked.tolist(), "localizing frames"):
        lenses = clip.depth_intrinsics[frame], clip.intrinsics[frame]
        poses = localizer.localize(clip.color(frame), clip.depth(frame), *lenses, masks[frame] == 0)
        if poses and (nearest is None or poses[0].inlier_ratio > nearest.inlier_ratio):
            nearest = poses[0]
        if poses and poses[0].probability >= config.min_probability:
            frames.append(frame)
            answers.append(poses[0])
    return FrameVotes(np.array(frames, int), answers, len(asked), nearest)


def agree(
    votes: FrameVotes,
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    gravity_known: bool,
    config: VoteConfig,
) -> Agreement | None:
    """Find the ``world_from_odometry`` that one vote proposes and most support (4 DoF with known gravity)."""
    if not len(votes.frame):
        return None
    odometry, voted = odometry_from_camera[votes.frame], votes.world_from_camera
    proposals = voted @ rigid.inverse(odometry)
    weight = votes.probability.copy()
    if gravity_known:
        tilt = np.arccos(np.clip(proposals[:, 1, 1], -1, 1))
        weight[tilt > np.deg2rad(config.max_tilt_deg)] = 0
        proposals = keep_upright(proposals, odometry[:, :3, 3], voted[:, :3, 3])
    tried = subsampling.evenly(len(proposals), MAX_PROPOSALS)
    support = np.stack([close(proposals[one] @ odometry, voted, config) for one in tried]) & (weight > 0)
    best = (support * weight).sum(1).argmax()
    chosen, supports = proposals[tried[best]], support[best]
    for _ in range(REFIT_ROUNDS):
        if not supports.any():
            return None
        rotation = rigid.mean_rotation(proposals[supports, :3, :3], weight[supports])
        offset = voted[supports, :3, 3] - odometry[supports, :3, 3] @ rotation.T
        chosen = rigid.make(rotation, np.average(offset, axis=0, weights=weight[supports]))
        supports = close(chosen @ odometry, voted, config) & (weight > 0)
    return Agreement(chosen, supports) if supports.any() else None


def keep_upright(
    proposals: Float[np.ndarray, "vote 4 4"],
    from_points: Float[np.ndarray, "vote 3"],
    to_points: Float[np.ndarray, "vote 3"],
) -> Float[np.ndarray, "vote 4 4"]:
    """Reduce motions to a turn about +y that still takes each point where it was taken."""
    yaw = np.arctan2(proposals[:, 0, 2] - proposals[:, 2, 0], proposals[:, 0, 0] + proposals[:, 2, 2])
    rotation = rigid.rotation_from_yaw(yaw)
    return rigid.make(rotation, to_points - np.einsum("vij,vj->vi", rotation, from_points))


def close(
    world_from_camera: Float[np.ndarray, "vote 4 4"],
    other: Float[np.ndarray, "*vote 4 4"],
    config: VoteConfig,
) -> Bool[np.ndarray, "vote"]:
    """Return which poses agree with others."""
    angle = np.rad2deg(rigid.rotation_angle(world_from_camera[:, :3, :3], other[..., :3, :3]))
    return (angle < config.agree_deg) & (
        np.linalg.norm(world_from_camera[:, :3, 3] - other[..., :3, 3], axis=-1) < config.agree_m
    )


def rejection_reason(votes: FrameVotes, supports: Bool[np.ndarray, "vote"] | None) -> str | None:
    """Return why the votes are not enough, None when they are."""
    if len(votes.frame) < MIN_VOTES:
        recognised = f"only {len(votes.frame)} of {votes.asked} frames were recognised"
        return f"{recognised}: the recording shows little of the walk-through's room"
    count = 0 if supports is None else int(supports.sum())
    if count < MIN_VOTES or count < MIN_SHARE * len(votes.frame):
        return f"only {count} of {len(votes.frame)} recognised frames agree on where the recording lies"
    return None
