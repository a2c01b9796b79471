"""Frames vote for where the recording lies in the world.

`collect` localises a subset of the frames, `agree` finds the one motion of the whole odometry that most
votes support, `refusal` says why a recording does not fit.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.files.clips import Clip, Masks
from pipeline.models.localizer import Hypothesis, Localizer
from pipeline.progress import track
from pipeline.space import rigid


@dataclass(frozen=True)
class VoteOptions:
    """Which frames vote, and when votes agree."""

    every_frames: int = 5
    """One frame in so many votes (2 Hz) ..."""
    least_asked: int = 20
    """... and more often in recordings so short that fewer than this would."""
    least_probability: float = 0.2
    """Votes below this probability are not cast."""
    agree_deg: float = 8.0
    """Votes agree within this rotation, degrees ..."""
    agree_m: float = 0.3
    """... and this distance, metres; room for the odometry's drift."""
    most_proposals: int = 400
    """At most so many votes, spread evenly, propose where the recording lies; all judge."""
    near_s: float = 6.0
    """Without the phone's odometry votes must agree with others as near as this, seconds."""
    most_tilt_deg: float = 10.0
    """A vote that contradicts gravity by more than this is not cast, degrees."""
    least_votes: int = 3
    """A recording needs so many agreeing votes ..."""
    least_share: float = 0.25
    """... and this share of all votes that were cast."""


@dataclass(frozen=True)
class Votes:
    """Localised frames."""

    frame: np.ndarray
    """[vote] i8: the frame that voted"""
    answers: list[Hypothesis]
    asked: int
    """Frames that were localised, with or without an answer."""
    nearest: Hypothesis | None
    """The best answer of all, believed or not: it tells the nearest view of the template."""

    @property
    def world_from_camera(self) -> Float[np.ndarray, "vote 4 4"]:
        """The voted poses."""
        return np.stack([answer.map_from_camera for answer in self.answers]) if self.answers else np.zeros((0, 4, 4))

    @property
    def probability(self) -> Float[np.ndarray, "vote"]:
        """How far each vote is to be trusted."""
        return np.array([answer.probability for answer in self.answers])


@dataclass(frozen=True)
class Agreement:
    """The motion that most votes support."""

    world_from_odometry: Float[np.ndarray, "4 4"]
    supports: Bool[np.ndarray, "vote"]


def none_cast() -> Votes:
    """Return what there is where no frame was asked."""
    return Votes(np.zeros(0, int), [], 0, None)


def collect(clip: Clip, masks: Masks, localizer: Localizer, options: VoteOptions) -> Votes:
    """Localise every so many frames, with the agent masked out."""
    step = min(options.every_frames, max(len(clip) // options.least_asked, 1))
    asked = np.arange(min(step // 2, len(clip) - 1), len(clip), step)
    frames, answers, nearest = [], [], None
    for frame in track(asked.tolist(), "localising frames"):
        found = localizer.localize(
            clip.color(frame),
            clip.depth(frame),
            clip.depth_intrinsics[frame],
            clip.intrinsics[frame],
            masks[frame] == 0,
        )
        if found and (nearest is None or found[0].inlier_ratio > nearest.inlier_ratio):
            nearest = found[0]
        if found and found[0].probability >= options.least_probability:
            frames.append(frame)
            answers.append(found[0])
    return Votes(np.array(frames, int), answers, len(asked), nearest)


def agree(
    votes: Votes, odometry_from_camera: Float[np.ndarray, "frame 4 4"], gravity_known: bool, options: VoteOptions
) -> Agreement | None:
    """Find ``world_from_odometry`` by letting each vote propose one and weighing who supports it (4 DoF where gravity
    is known).
    """
    if not len(votes.frame):
        return None
    odometry, voted = odometry_from_camera[votes.frame], votes.world_from_camera
    proposals = voted @ rigid.inverse(odometry)
    weight = votes.probability.copy()
    if gravity_known:
        tilt = np.arccos(np.clip(proposals[:, 1, 1], -1, 1))
        weight[tilt > np.deg2rad(options.most_tilt_deg)] = 0
        proposals = keep_upright(proposals, odometry[:, :3, 3], voted[:, :3, 3])
    heard = np.unique(np.linspace(0, len(proposals) - 1, options.most_proposals).astype(int))
    support = np.stack([close(proposals[one] @ odometry, voted, options) for one in heard]) & (weight > 0)
    best = (support * weight).sum(1).argmax()
    chosen, supports = proposals[heard[best]], support[best]
    for _ in range(3):
        if not supports.any():
            return None
        rotation = rigid.mean_rotation(proposals[supports, :3, :3], weight[supports])
        offset = voted[supports, :3, 3] - odometry[supports, :3, 3] @ rotation.T
        chosen = rigid.make(rotation, np.average(offset, axis=0, weights=weight[supports]))
        supports = close(chosen @ odometry, voted, options) & (weight > 0)
    return Agreement(chosen, supports) if supports.any() else None


def keep_upright(
    proposals: Float[np.ndarray, "vote 4 4"],
    from_points: Float[np.ndarray, "vote 3"],
    to_points: Float[np.ndarray, "vote 3"],
) -> Float[np.ndarray, "vote 4 4"]:
    """Reduce motions to a turn about +y that still takes each point where it was taken."""
    yaw = np.arctan2(proposals[:, 0, 2] - proposals[:, 2, 0], proposals[:, 0, 0] + proposals[:, 2, 2])
    rotation = rigid.rotation_from_vector(yaw[:, None] * np.array([0.0, 1.0, 0.0]))
    return rigid.make(rotation, to_points - np.einsum("vij,vj->vi", rotation, from_points))


def close(
    world_from_camera: Float[np.ndarray, "vote 4 4"], other: Float[np.ndarray, "*vote 4 4"], options: VoteOptions
) -> Bool[np.ndarray, "vote"]:
    """Tell which poses agree with others."""
    angle = np.rad2deg(rigid.rotation_angle(world_from_camera[:, :3, :3], other[..., :3, :3]))
    return (angle < options.agree_deg) & (np.linalg.norm(world_from_camera[:, :3, 3] - other[..., :3, 3], axis=-1) < options.agree_m)


def refusal(votes: Votes, supports: Bool[np.ndarray, "vote"] | None, options: VoteOptions) -> str | None:
    """Say why the votes are not enough, None when they are."""
    if len(votes.frame) < options.least_votes:
        recognised = f"only {len(votes.frame)} of {votes.asked} frames were recognised"
        return f"{recognised}: the recording shows little of the walk-through's room"
    count = 0 if supports is None else int(supports.sum())
    if count < options.least_votes or count < options.least_share * len(votes.frame):
        return f"only {count} of {len(votes.frame)} recognised frames agree on where the recording lies"
    return None
