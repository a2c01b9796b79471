"""Register one recording: votes, agreement, alignment, confidence, agent roots, or the reason why it does not fit."""

from dataclasses import dataclass, field
from typing import Literal, assert_never

import numpy as np
from jaxtyping import Bool, Float

from pipeline.files.clips import Clip, Masks
from pipeline.models.localizer import Localizer
from pipeline.progress import log
from pipeline.space import rigid
from pipeline.space.meshes import Mesh, RayCaster
from pipeline.space.visual_odometry import Followed, FollowOptions
from stages.register_videos import alignment, following
from stages.register_videos import votes as voting
from stages.register_videos.agent_roots import RootOptions, Roots, find_roots
from stages.register_videos.alignment import Aligned, AlignOptions
from stages.register_videos.body import Ground
from stages.register_videos.confidence import ConfidenceOptions, agent_confidence, camera_confidence, compare, looks_right
from stages.register_videos.votes import VoteOptions, Votes


@dataclass(frozen=True)
class GateOptions:
    """When an aligned recording is believed."""

    least_measured: float = 0.2
    """Share of the frames that must have static depth to measure ..."""
    least_fit: float = 0.35
    """... and median share of it, in these frames, that must lie within 5 cm of the template."""
    least_certainty: float = 0.5
    """Where not even `least_votes` of the agreeing votes have this probability, ..."""
    least_recognised: float = 0.2
    """... this share of the frames that were asked must agree: sessions of the room itself have 0.37 and more, of a flat of the
    same shape with the same furniture elsewhere 0.1, ...
    """
    least_right: float = 0.3
    """... and this share of the frames must look more like their renderings than like renderings from wrong places: right places
    have 0.6 and more, by lamplight and on a real kitchen too; that flat has 0.5, repainted rooms at most 0.1.
    """


@dataclass(frozen=True)
class Options:
    """How a recording is registered."""

    begin: Literal["votes", "middle"] = "votes"
    """votes: localised frames place the recording; middle: it begins in the middle of the room with the heading that its
    odometry happens to have, and is never refused (the ablation without a localizer).
    """
    odometry: Literal["phone", "pictures"] = "phone"
    """phone: its own poses where the recording has them; pictures: poses are always followed from picture to picture."""
    vote: VoteOptions = field(default_factory=VoteOptions)
    """Which frames vote, and when votes agree."""
    follow: FollowOptions = field(default_factory=FollowOptions)
    """How pictures are followed where the phone gave no odometry."""
    align: AlignOptions = field(default_factory=AlignOptions)
    """Weights, reach and rounds of the alignment."""
    gate: GateOptions = field(default_factory=GateOptions)
    """When a recording is believed."""
    confidence: ConfidenceOptions = field(default_factory=ConfidenceOptions)
    """How sure each frame's pose is."""
    animal: bool = True
    """False: cameras alone, for tables that compare nothing else."""
    root: RootOptions = field(default_factory=RootOptions)
    """How the animal is placed."""


@dataclass(frozen=True)
class Maps:
    """What a recording is registered to."""

    scene: Mesh
    agent: Mesh
    scene_localizer: Localizer
    agent_localizer: Localizer


@dataclass(frozen=True)
class Registered:
    """A recording in the world."""

    aligned: Aligned
    confidence: Float[np.ndarray, "frame"]
    """P(camera within 2 deg and 5 cm)"""
    roots: Roots
    agent_confidence: Float[np.ndarray, "frame"]
    votes: Votes
    supports: Bool[np.ndarray, "vote"]
    likeness: float
    """Share of the frames that look more like their rendering than like renderings from wrong places."""

    def tables(self) -> dict[str, np.ndarray]:
        """Return the arrays of ``poses.npz`` but the time."""
        return {
            "world_from_camera": self.aligned.world_from_camera,
            "world_from_agent": self.roots.world_from_agent,
            "confidence": self.confidence.astype(np.float32),
            "agent_confidence": self.agent_confidence.astype(np.float32),
            "agent_visible": self.roots.visible,
        }


@dataclass(frozen=True)
class Refused:
    """A recording that does not fit, and why."""

    reason: str
    votes: Votes


def register(clip: Clip, masks: Masks, maps: Maps, options: Options, rng: np.random.Generator) -> Registered | Refused:
    """Register one recording, or refuse it with a reason."""
    motion = _motion(clip, masks, options, rng)
    match options.begin:
        case "votes":
            votes = voting.collect(clip, masks, maps.scene_localizer, options.vote)
            start = _begin(clip, votes, motion, options.vote)
            reason = voting.refusal(votes, start.supports if start else None, options.vote)
            if reason is not None:
                return Refused(reason, votes)
        case "middle":
            votes, start = voting.none_cast(), _in_the_middle(motion, maps.scene)
        case _:
            assert_never(options.begin)
    log(f"{int(start.supports.sum())} of {votes.asked} localised frames agree")
    aligned = alignment.align(clip, masks, maps.scene, start.world_from_camera, motion.relatives, votes, start.supports, options.align)
    measured = f"{int(np.isfinite(aligned.fit).sum())} of {len(clip)} frames"
    log(f"static depth of {measured}: {aligned.usual_gap_m * 100:.1f} cm from the template, {aligned.usual_fit:.0%} within 5 cm")
    caster = RayCaster(maps.scene)
    alike = compare(clip, masks, caster, aligned.world_from_camera, options.confidence, rng)
    looks = looks_right(clip.timestamp_s, alike, options.confidence)
    reason = strange(aligned.fit, float(looks.mean()), votes, start.supports, options) if options.begin == "votes" else None
    if reason is not None:
        return Refused(reason, votes)
    confidence = camera_confidence(aligned.spread, looks, start.anchored, options.confidence, rng)
    roots = Roots.unseen(len(clip))
    if options.animal:
        ground = Ground(caster, float(np.quantile(maps.scene.vertices[:, 1], 0.02)))
        roots = find_roots(clip, masks, maps.agent, ground, maps.agent_localizer, aligned.world_from_camera, options.root, rng)
        log(f"the animal was placed in {int(roots.visible.sum())} of {len(clip)} frames")
    return Registered(aligned, confidence, roots, agent_confidence(roots), votes, start.supports, float(looks.mean()))


@dataclass(frozen=True)
class _Start:
    """Where the alignment begins."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    supports: Bool[np.ndarray, "vote"]
    anchored: Bool[np.ndarray, "frame"]
    """False: no vote holds this frame, and nothing was followed to it."""


def _motion(clip, masks, options, rng) -> Followed:
    """Return the motions between neighbours: the phone's, or those that the pictures tell."""
    if options.odometry == "phone" and clip.odometry_from_camera is not None:
        kept = following.keep(clip, options.align, options.follow)
        if kept.torn.any():
            log(f"the phone's odometry jumps before {int(kept.torn.sum())} of {len(clip)} frames: what lies between is placed on its own")
        return kept
    followed = following.follow(clip, masks, options.follow, rng)
    log(f"no odometry: {int(followed.torn.sum())} of {len(clip)} motions could not be followed from picture to picture")
    return followed


def _begin(clip, votes, motion, vote_options) -> _Start | None:
    """Place the recording by its votes; None where none agree."""
    if not len(votes.frame):
        return None
    if motion.odometry_from_camera is clip.odometry_from_camera:
        found = voting.agree(votes, clip.odometry_from_camera, clip.gravity_known, vote_options)
        everywhere = np.ones(len(clip), bool)
        return _Start(found.world_from_odometry @ clip.odometry_from_camera, found.supports, everywhere) if found else None
    supports = following.agree_nearby(votes, clip.timestamp_s, motion, vote_options)
    if not supports.any():
        return None
    poses = following.carry(votes, supports, clip.timestamp_s, motion)
    return _Start(poses, supports, following.anchored(votes, supports, motion))


def strange(
    fit: Float[np.ndarray, "frame"], right: float, votes: Votes, supports: Bool[np.ndarray, "vote"], options: Options
) -> str | None:
    """Say why an aligned recording is not believed, None when it is."""
    known = fit[np.isfinite(fit)]
    if not len(known) or len(known) < options.gate.least_measured * len(fit):
        count = f"only {len(known)} of {len(fit)} frames measured the room's depth"
        return f"{count}: it is too dark or too far away, or the animal fills the view"
    if np.median(known) < options.gate.least_fit:
        share = f"only {np.median(known):.0%} of the static depth lies within 5 cm of the room"
        return f"{share}: it has changed too much, or the place was mistaken"
    if (votes.probability[supports] >= options.gate.least_certainty).sum() >= options.vote.least_votes:
        return None
    if supports.sum() < options.gate.least_recognised * votes.asked:
        told = f"only {supports.sum()} of {votes.asked} frames were recognised and agree"
    elif right < options.gate.least_right:
        told = f"only {right:.0%} of the frames look more like the room than like wrong places in it"
    else:
        return None
    return f"the room has the same shape but looks different: {told}, and hardly a frame was recognised with certainty"


def _in_the_middle(motion, scene) -> _Start:
    """Stand the recording in the middle of the room, a metre and a half above the floor, unturned."""
    odometry = motion.odometry_from_camera
    middle = (scene.vertices.min(0) + scene.vertices.max(0)) / 2
    middle[1] = scene.vertices[:, 1].min() + 1.5
    shift = rigid.make(np.eye(3), middle - odometry[:, :3, 3].mean(0))
    return _Start(shift @ odometry, np.zeros(0, bool), np.ones(len(odometry), bool))
