"""Register one recording, or reject it with a reason."""

from dataclasses import dataclass
from typing import assert_never

import numpy as np
from jaxtyping import Bool, Float

from pipeline.core.progress import log
from pipeline.data.clips import Clip, Masks
from pipeline.data.poses import RegisteredPoses
from pipeline.geometry import rigid
from pipeline.geometry.contact import StandingSurface
from pipeline.geometry.meshes import Mesh, RayCaster
from pipeline.localization.localizer import Localizer
from pipeline.mapping.visual_odometry import Odometry
from stages.register_videos import alignment, odometry
from stages.register_videos import votes as voting
from stages.register_videos.agent_roots import Roots, find_roots
from stages.register_videos.alignment import AlignedCameras
from stages.register_videos.comparison import AnimalSize, compare_sizes
from stages.register_videos.confidence import (
    agent_confidence,
    appearance_probability,
    camera_confidence,
    score_appearance,
)
from stages.register_videos.config import Config
from stages.register_videos.feature_alignment import FeatureMap
from stages.register_videos.point_alignment import Walkthrough
from stages.register_videos.votes import MIN_VOTES, FrameVotes

MIN_MEASURED = 0.2
"""Least share of frames with static depth."""
MIN_RECOGNIZED = 0.2
"""Least share of localized frames with inlier votes if no vote is certain: sessions of the room itself have
0.37 and more, sessions of a flat with the same shape and furniture 0.1."""
EYE_HEIGHT_M = 1.5
"""Camera height for the initialization in the middle of the room, meters."""


@dataclass(frozen=True)
class Maps:
    """Templates and localizers that a recording is registered to."""

    scene: Mesh
    floor_m: float
    """Height of the scene's floor, world."""
    agent: Mesh
    scene_localizer: Localizer
    agent_localizer: Localizer
    scene_features: Float[np.ndarray, "vertex channel"] | None = None
    """Features of the scene's vertices; None: no feature-metric alignment."""
    walk: Walkthrough | None = None
    """The walk-through, for aligning recordings without odometry to its pictures; None: not aligned."""


@dataclass(frozen=True)
class Registered:
    """A registered recording."""

    aligned: AlignedCameras
    confidence: Float[np.ndarray, "frame"]
    """P(camera within 2 deg and 5 cm)."""
    roots: Roots
    agent_confidence: Float[np.ndarray, "frame"]
    votes: FrameVotes
    inliers: Bool[np.ndarray, "vote"]
    appearance: float
    """Share of the frames that match their rendering better than renderings from wrong poses."""
    size: AnimalSize | None = None
    """The template's silhouette against the masks; None if the animal is not placed."""

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
    """A rejected recording, and why."""

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
    motion = _choose_odometry(clip, masks, config, rng)
    match "map" if clip.mapped else config.initialization:
        case "map":
            assert clip.odometry_from_camera is not None, "mapped clips have cameras from the map"
            votes = voting.no_votes()
            start = _InitialPoses(clip.odometry_from_camera, np.zeros(0, bool), np.ones(len(clip), bool))
        case "votes":
            votes = voting.collect(clip, masks, maps.scene_localizer, config.vote)
            start = _initialize(clip, votes, motion, config.vote)
            reason = voting.rejection_reason(votes, start.inliers if start else None)
            if start is None or reason is not None:
                return Rejected(reason or "no votes agree", votes)
        case "middle":
            votes, start = voting.no_votes(), _initialize_in_the_middle(motion, maps.scene)
        case _:
            assert_never(config.initialization)
    log(f"{int(start.inliers.sum())} of {votes.queries} localized frames agree")
    caster = RayCaster(maps.scene)
    scene = None
    if maps.scene_features is not None and features is not None:
        scene = FeatureMap(caster, maps.scene_features, features)
    aligned = _align(clip, masks, caster, scene, start, motion, votes, config, maps.walk)
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
        reason = rejection_reason(aligned.fit, float(appearance.mean()), votes, start.inliers, config)
        if reason is not None:
            return Rejected(reason, votes)
    confidence = camera_confidence(aligned.pose_covariance, appearance, start.anchored, rng)
    roots, size = Roots.unseen(len(clip)), None
    if config.animal:
        standing = StandingSurface(caster, maps.floor_m)
        cameras = aligned.world_from_camera
        roots = find_roots(clip, masks, maps.agent, standing, maps.agent_localizer, cameras, config.root, rng)
        log(f"the animal was placed in {int(roots.visible.sum())} of {len(clip)} frames")
        size = compare_sizes(clip, masks, maps.agent, cameras, roots.world_from_agent)
    share = float(appearance.mean())
    certain = agent_confidence(roots)
    return Registered(aligned, confidence, roots, certain, votes, start.inliers, share, size)


@dataclass(frozen=True)
class _InitialPoses:
    """Initial poses of the alignment."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    inliers: Bool[np.ndarray, "vote"]
    anchored: Bool[np.ndarray, "frame"]
    """Frames in an odometry segment with an inlier vote."""


def _align(
    clip: Clip,
    masks: Masks,
    caster: RayCaster,
    scene: FeatureMap | None,
    start: _InitialPoses,
    motion: Odometry,
    votes: FrameVotes,
    config: Config,
    walk: Walkthrough | None,
) -> AlignedCameras:
    """Align the cameras to the scene; keep those that come from the map."""
    cameras, relative = start.world_from_camera, motion.relative_poses
    if clip.mapped:
        return alignment.keep_cameras(clip, masks, caster, cameras, relative, config.alignment)
    walk = None if _uses_device_odometry(clip, config) else walk
    return alignment.align(
        clip, masks, caster, scene, cameras, relative, votes, start.inliers, config.alignment, walk
    )


def _uses_device_odometry(clip, config) -> bool:
    return config.odometry == "device" and clip.odometry_from_camera is not None


def _choose_odometry(clip, masks, config, rng) -> Odometry:
    """Return the device's odometry, or visual odometry."""
    if _uses_device_odometry(clip, config):
        device = odometry.device_odometry(clip)
        if device.jumps.any():
            jumps = f"{int(device.jumps.sum())} of {len(clip)} frames"
            log(f"tracking jumps before {jumps}: each segment is placed by its own votes")
        return device
    visual = odometry.estimate_odometry(clip, masks, rng)
    log(f"visual odometry: {int(visual.jumps.sum())} of {len(clip)} motions are unknown")
    return visual


def _initialize(clip, votes, motion, config) -> _InitialPoses | None:
    """Return initial poses by the votes; None if no votes agree."""
    if not len(votes.frame):
        return None
    if motion.odometry_from_camera is clip.odometry_from_camera:
        agreement = voting.find_agreement(votes, clip.odometry_from_camera, clip.gravity_known, config)
        if agreement is None:
            return None
        poses = agreement.world_from_odometry @ clip.odometry_from_camera
        return _InitialPoses(poses, agreement.inliers, np.ones(len(clip), bool))
    inliers = odometry.consistent_votes(votes, clip.timestamp_s, motion, config)
    if not inliers.any():
        return None
    poses = odometry.propagate_votes(votes, inliers, clip.timestamp_s, motion)
    segment = np.cumsum(motion.jumps)
    return _InitialPoses(poses, inliers, np.isin(segment, segment[votes.frame[inliers]]))


def rejection_reason(
    fit: Float[np.ndarray, "frame"],
    appearance: float,
    votes: FrameVotes,
    inliers: Bool[np.ndarray, "vote"],
    config: Config,
) -> str | None:
    """Return why an aligned recording is rejected; None if it is accepted."""
    known = fit[np.isfinite(fit)]
    if not len(known) or len(known) < MIN_MEASURED * len(fit):
        count = f"only {len(known)} of {len(fit)} frames measured the room's depth"
        return f"{count}: it is too dark or too far away, or the animal fills the view"
    if np.median(known) < config.gate.min_fit:
        share = f"only {np.median(known):.0%} of the static depth lies within 5 cm of the room"
        return f"{share}: the room has changed too much, or the pose is wrong"
    if (votes.probability[inliers] >= config.gate.min_certainty).sum() >= MIN_VOTES:
        return None
    if inliers.sum() < MIN_RECOGNIZED * votes.queries:
        evidence = f"only {inliers.sum()} of {votes.queries} frames were recognized and agree"
    elif appearance < config.gate.min_appearance:
        evidence = f"only {appearance:.0%} of the frames look more like the room than like wrong places in it"
    else:
        return None
    return (
        f"the room has the same shape but looks different: {evidence}, "
        "and hardly a frame was recognized with certainty"
    )


def _initialize_in_the_middle(motion, scene) -> _InitialPoses:
    """Return initial poses in the middle of the room at eye height, with the odometry's heading."""
    path = motion.odometry_from_camera
    middle = (scene.vertices.min(0) + scene.vertices.max(0)) / 2
    middle[1] = scene.vertices[:, 1].min() + EYE_HEIGHT_M
    shift = rigid.make(np.eye(3), middle - path[:, :3, 3].mean(0))
    return _InitialPoses(shift @ path, np.zeros(0, bool), np.ones(len(path), bool))
