"""Localized frames vote for the transform of the recording's odometry to the world.

`collect` localizes a subset of the frames, `find_agreement` finds the transform with most inlier votes,
`rejection_reason` returns why there are too few.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.core.progress import track
from pipeline.data.clips import Clip, Masks
from pipeline.geometry import rigid, subsampling
from pipeline.localization.localizer import Localizer, PoseHypothesis
from stages.register_videos.config import VoteConfig

MIN_VOTES, MIN_SHARE = 3, 0.25
"""Least number and share of inlier votes: two may agree by chance."""
MIN_LOCALIZED = 20
"""Least number of localized frames, for short recordings."""
MAX_PROPOSALS = 400
"""Largest number of proposed transforms; each is scored by all votes."""
REFIT_ROUNDS = 3
"""Refits of the best proposal to its inliers."""


@dataclass(frozen=True)
class FrameVotes:
    """Poses of localized frames."""

    frame: Int[np.ndarray, "vote"]
    hypotheses: list[PoseHypothesis]
    queries: int
    """Number of localizer queries, with or without a pose."""
    nearest: PoseHypothesis | None
    """The pose of largest inlier ratio, even if improbable: the nearest view of the template."""

    @property
    def world_from_camera(self) -> Float[np.ndarray, "vote 4 4"]:
        """The voted poses."""
        if self.hypotheses:
            return np.stack([hypothesis.map_from_camera for hypothesis in self.hypotheses])
        return np.zeros((0, 4, 4))

    @property
    def probability(self) -> Float[np.ndarray, "vote"]:
        """Probability of each vote."""
        return np.array([hypothesis.probability for hypothesis in self.hypotheses])


@dataclass(frozen=True)
class Agreement:
    """The transform with most inlier votes."""

    world_from_odometry: Float[np.ndarray, "4 4"]
    inliers: Bool[np.ndarray, "vote"]


def no_votes() -> FrameVotes:
    """Return the votes of a recording without localizer queries."""
    return FrameVotes(np.zeros(0, int), [], 0, None)


def collect(clip: Clip, masks: Masks, localizer: Localizer, config: VoteConfig) -> FrameVotes:
    """Localize every ``every_frames``-th frame, with the agent masked out."""
    step = min(config.every_frames, max(len(clip) // MIN_LOCALIZED, 1))
    queries = np.arange(min(step // 2, len(clip) - 1), len(clip), step)
    frames, hypotheses, nearest = [], [], None
    for frame in track(queries.tolist(), "localizing frames"):
        lenses = clip.depth_intrinsics[frame], clip.intrinsics[frame]
        poses = localizer.localize(clip.color(frame), clip.depth(frame), *lenses, masks[frame] == 0)
        if poses and (nearest is None or poses[0].inlier_ratio > nearest.inlier_ratio):
            nearest = poses[0]
        if poses and poses[0].probability >= config.min_probability:
            frames.append(frame)
            hypotheses.append(poses[0])
    return FrameVotes(np.array(frames, int), hypotheses, len(queries), nearest)


def find_agreement(
    votes: FrameVotes,
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    gravity_known: bool,
    config: VoteConfig,
) -> Agreement | None:
    """Return the proposed ``world_from_odometry`` with most inliers (4 DoF if gravity is known)."""
    if not len(votes.frame):
        return None
    odometry, voted = odometry_from_camera[votes.frame], votes.world_from_camera
    proposals = voted @ rigid.inverse(odometry)
    weight = votes.probability.copy()
    if gravity_known:
        tilt = np.arccos(np.clip(proposals[:, 1, 1], -1, 1))
        weight[tilt > np.deg2rad(config.max_tilt_deg)] = 0
        # rotations restricted to yaw still map each camera to its voted place
        yaw = np.arctan2(proposals[:, 0, 2] - proposals[:, 2, 0], proposals[:, 0, 0] + proposals[:, 2, 2])
        rotation = rigid.rotation_from_yaw(yaw)
        moved = np.einsum("vij,vj->vi", rotation, odometry[:, :3, 3])
        proposals = rigid.make(rotation, voted[:, :3, 3] - moved)
    sampled = subsampling.evenly(len(proposals), MAX_PROPOSALS)
    inlier_sets = np.stack([are_close(proposals[i] @ odometry, voted, config) for i in sampled])
    inlier_sets &= weight > 0
    best = (inlier_sets * weight).sum(1).argmax()
    transform, inliers = proposals[sampled[best]], inlier_sets[best]
    for _ in range(REFIT_ROUNDS):
        if not inliers.any():
            return None
        rotation = rigid.mean_rotation(proposals[inliers, :3, :3], weight[inliers])
        offset = voted[inliers, :3, 3] - odometry[inliers, :3, 3] @ rotation.T
        transform = rigid.make(rotation, np.average(offset, axis=0, weights=weight[inliers]))
        inliers = are_close(transform @ odometry, voted, config) & (weight > 0)
    return Agreement(transform, inliers) if inliers.any() else None


def are_close(
    world_from_camera: Float[np.ndarray, "vote 4 4"],
    other: Float[np.ndarray, "*vote 4 4"],
    config: VoteConfig,
) -> Bool[np.ndarray, "vote"]:
    """Return which poses agree within the configured tolerances."""
    angle = np.rad2deg(rigid.rotation_angle(world_from_camera[:, :3, :3], other[..., :3, :3]))
    return (angle < config.agree_deg) & (
        np.linalg.norm(world_from_camera[:, :3, 3] - other[..., :3, 3], axis=-1) < config.agree_m
    )


def rejection_reason(votes: FrameVotes, inliers: Bool[np.ndarray, "vote"] | None) -> str | None:
    """Return why the votes are insufficient; None if they suffice."""
    if len(votes.frame) < MIN_VOTES:
        recognized = f"only {len(votes.frame)} of {votes.queries} frames were recognized"
        return f"{recognized}: the recording shows little of the walk-through's room"
    count = 0 if inliers is None else int(inliers.sum())
    if count < MIN_VOTES or count < MIN_SHARE * len(votes.frame):
        return f"only {count} of {len(votes.frame)} recognized frames agree on where the recording lies"
    return None
