"""Register one recording, or give the reason why it does not fit."""

from dataclasses import dataclass
from typing import assert_never

import numpy as np
from jaxtyping import Bool, Float

from pipeline.core.progress import log
from pipeline.data.clips import Clip, Masks
from pipeline.data.poses import RegisteredPoses
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh, RayCaster
from pipeline.localization.localizer import Localizer
from pipeline.mapping.visual_odometry import Odometry
from stages.register_videos import alignment, odometry
from stages.register_videos import votes as voting
from stages.register_videos.agent_fit import StandingSurface
from stages.register_videos.agent_roots import Roots, find_roots
from stages.register_videos.alignment import AlignedCameras
from stages.register_videos.confidence import (
    agent_confidence,
    appearance_probability,
    camera_confidence,
    score_appearance,
)
from stages.register_videos.config import Config
from stages.register_videos.feature_alignment import FeatureMap
from stages.register_videos.point_alignment import Walk
from stages.register_videos.votes import MIN_VOTES, FrameVotes

MIN_MEASURED = 0.2
"""Share of the frames that must have static depth."""
MIN_RECOGNIZED = 0.2
"""Without certain votes this share of the localized frames must agree: sessions of the room itself have 0.37
and more, of a flat of the same shape with the same furniture elsewhere 0.1."""
FLOOR_QUANTILE = 0.02
"""Quantile of the template's heights that is the floor's."""
EYE_HEIGHT_M = 1.5
"""Height of a session that starts in the middle of the room, metres."""


@dataclass(frozen=True)
class Maps:
    """What a recording is registered to."""

    scene: Mesh
    agent: Mesh
    scene_localizer: Localizer
    agent_localizer: Localizer
    scene_features: Float[np.ndarray, "vertex channel"] | None = None
    """Features of the scene's vertices; None: no feature-metric alignment."""
    walk: Walk | None = None
    """The walk-through, to whose pictures a recording without odometry is aligned; None: it is not."""

    @property
    def floor_m(self) -> float:
        """Height of the scene's floor, world."""
        return float(np.quantile(self.scene.vertices[:, 1], FLOOR_QUANTILE))


@dataclass(frozen=True)
class Registered:
    """A recording in the world."""

    aligned: AlignedCameras
    confidence: Float[np.ndarray, "frame"]
    """P(camera within 2 deg and 5 cm)."""
    roots: Roots
    agent_confidence: Float[np.ndarray, "frame"]
    votes: FrameVotes
    supports: Bool[np.ndarray, "vote"]
    appearance: float
    """Share of the frames that look more like their rendering than like renderings from wrong poses."""

    def poses(self, timestamp_s: Float[np.ndarray, "frame"]) -> RegisteredPoses:
        """Return what `poses.npz` holds, at the recording's times in seconds."""
        return RegisteredPoses(
            timestamp_s,
            self.aligned.world_from_camera,
            self.roots.world_from_agent,
            self.confidence,
            self.agent_confidence,
            self.roots.visible,
        )


@dataclass(frozen=True)
class Rejected:
    """A recording that does not fit, and why."""

    reason: str
    votes: FrameVotes


def register(
    clip: Clip,
    masks: Masks,
    maps: Maps,
    config: Config,
    rng: np.random.Generator,
    features: Float[np.ndarray, "frame rows columns channel"] | None = None,
) -> Registered | Rejected:
    """Register one recording, or reject it with a reason; ``features`` are the session's, at stride 8."""
    motion = _odometry(clip, masks, config, rng)
    match "map" if clip.mapped else config.initialization:
        case "map":
            assert clip.odometry_from_camera is not None, "its cameras come from the map"
            votes = voting.none_cast()
            start = _Start(clip.odometry_from_camera, np.zeros(0, bool), np.ones(len(clip), bool))
        case "votes":
            votes = voting.collect(clip, masks, maps.scene_localizer, config.vote)
            start = _initialize(clip, votes, motion, config.vote)
            reason = voting.rejection_reason(votes, start.supports if start else None)
            if start is None or reason is not None:
                return Rejected(reason or "no votes agree", votes)
        case "middle":
            votes, start = voting.none_cast(), _in_the_middle(motion, maps.scene)
        case _:
            assert_never(config.initialization)
    log(f"{int(start.supports.sum())} of {votes.asked} localized frames agree")
    caster = RayCaster(maps.scene)
    scene = None
    if maps.scene_features is not None and features is not None:
        scene = FeatureMap(caster, maps.scene_features, features)
    aligned = _aligned(clip, masks, caster, scene, start, motion, votes, config, maps.walk)
    measured = f"{int(np.isfinite(aligned.fit).sum())} of {len(clip)} frames"
    gap = f"{aligned.median_gap_m * 100:.1f} cm from the template, {aligned.median_fit:.0%} within 5 cm"
    log(f"static depth of {measured}: {gap}")
    scores = score_appearance(clip, masks, caster, aligned.world_from_camera, config.confidence, rng)
    appearance = appearance_probability(clip.timestamp_s, scores)
    if clip.mapped:
        if appearance.mean() < config.gate.min_appearance:
            share = f"only {appearance.mean():.0%} of the frames"
            return Rejected(f"{share} look more like the room than like wrong places in it", votes)
    elif config.initialization == "votes":
        reason = rejection_reason(aligned.fit, float(appearance.mean()), votes, start.supports, config)
        if reason is not None:
            return Rejected(reason, votes)
    confidence = camera_confidence(aligned.pose_covariance, appearance, start.anchored, rng)
    roots = Roots.unseen(len(clip))
    if config.animal:
        standing = StandingSurface(caster, maps.floor_m)
        cameras = aligned.world_from_camera
        roots = find_roots(clip, masks, maps.agent, standing, maps.agent_localizer, cameras, config.root, rng)
        log(f"the animal was placed in {int(roots.visible.sum())} of {len(clip)} frames")
    return Registered(
        aligned, confidence, roots, agent_confidence(roots), votes, start.supports, float(appearance.mean())
    )


@dataclass(frozen=True)
class _Start:
    """Initial poses of the alignment."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    supports: Bool[np.ndarray, "vote"]
    anchored: Bool[np.ndarray, "frame"]
    """False: no vote holds this frame or the unbroken odometry around it."""


def _aligned(
    clip: Clip,
    masks: Masks,
    caster: RayCaster,
    scene: FeatureMap | None,
    start: _Start,
    motion: Odometry,
    votes: FrameVotes,
    config: Config,
    walk: Walk | None,
) -> AlignedCameras:
    """Align the cameras with the scene; where they come from the map, keep them."""
    cameras, relative = start.world_from_camera, motion.relative_poses
    if clip.mapped:
        return alignment.keep(clip, masks, caster, cameras, relative, config.alignment)
    walk = None if _tracked_itself(clip, config) else walk
    return alignment.align(
        clip, masks, caster, scene, cameras, relative, votes, start.supports, config.alignment, walk
    )


def _tracked_itself(clip, config) -> bool:
    return config.odometry == "device" and clip.odometry_from_camera is not None


def _odometry(clip, masks, config, rng) -> Odometry:
    """Return the motions between neighbours: the device's, or visual odometry."""
    if _tracked_itself(clip, config):
        device = odometry.of_device(clip)
        if device.jumps.any():
            jumps = f"{int(device.jumps.sum())} of {len(clip)} frames"
            log(f"tracking jumps before {jumps}: the pieces between are placed by their own votes")
        return device
    visual = odometry.of_pictures(clip, masks, rng)
    log(f"visual odometry: {int(visual.jumps.sum())} of {len(clip)} motions are unknown")
    return visual


def _initialize(clip, votes, motion, config) -> _Start | None:
    """Place the recording by its votes; None where none agree."""
    if not len(votes.frame):
        return None
    if motion.odometry_from_camera is clip.odometry_from_camera:
        agreement = voting.agree(votes, clip.odometry_from_camera, clip.gravity_known, config)
        if agreement is None:
            return None
        poses = agreement.world_from_odometry @ clip.odometry_from_camera
        return _Start(poses, agreement.supports, np.ones(len(clip), bool))
    supports = odometry.consistent_votes(votes, clip.timestamp_s, motion, config)
    if not supports.any():
        return None
    poses = odometry.propagate_votes(votes, supports, clip.timestamp_s, motion)
    return _Start(poses, supports, odometry.anchored(votes, supports, motion))


def rejection_reason(
    fit: Float[np.ndarray, "frame"],
    appearance: float,
    votes: FrameVotes,
    supports: Bool[np.ndarray, "vote"],
    config: Config,
) -> str | None:
    """Return why an aligned recording is not accepted, None when it is."""
    known = fit[np.isfinite(fit)]
    if not len(known) or len(known) < MIN_MEASURED * len(fit):
        count = f"only {len(known)} of {len(fit)} frames measured the room's depth"
        return f"{count}: it is too dark or too far away, or the animal fills the view"
    if np.median(known) < config.gate.min_fit:
        share = f"only {np.median(known):.0%} of the static depth lies within 5 cm of the room"
        return f"{share}: it has changed too much, or the place was mistaken"
    if (votes.probability[supports] >= config.gate.min_certainty).sum() >= MIN_VOTES:
        return None
    if supports.sum() < MIN_RECOGNIZED * votes.asked:
        evidence = f"only {supports.sum()} of {votes.asked} frames were recognised and agree"
    elif appearance < config.gate.min_appearance:
        evidence = f"only {appearance:.0%} of the frames look more like the room than like wrong places in it"
    else:
        return None
    return (
        f"the room has the same shape but looks different: {evidence}, "
        "and hardly a frame was recognised with certainty"
    )


def _in_the_middle(motion, scene) -> _Start:
    """Place the recording in the middle of the room at eye height, with the odometry's heading."""
    path = motion.odometry_from_camera
    middle = (scene.vertices.min(0) + scene.vertices.max(0)) / 2
    middle[1] = scene.vertices[:, 1].min() + EYE_HEIGHT_M
    shift = rigid.make(np.eye(3), middle - path[:, :3, 3].mean(0))
    return _Start(shift @ path, np.zeros(0, bool), np.ones(len(path), bool))
