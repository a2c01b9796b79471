"""Registration against clicked correspondences: what a real capture has in place of truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from pipeline.core.videos import Video
from pipeline.data import clicks
from pipeline.data.clicks import ClickedClip
from pipeline.data.poses import RegisteredPoses
from pipeline.data.templates import SceneCameras
from pipeline.geometry import rigid
from pipeline.metrics.metrics import Metrics
from pipeline.metrics.pose_errors import joined, pose_errors
from stages.evaluate.reading import BuildFolders
from stages.evaluate.registration import put_cameras

TRUSTED_M = 0.10
"""frames whose clicks disagree by more than this are left out, meters"""
NO_CLICKS = "the true poses of this capture are not known; click some with `make annotate`"
NAMES = tuple(
    f"registration/{unit}_{which}"
    for unit in ("rotation_deg", "translation_m")
    for which in ("median", "p95")
)
OWN_NAMES = ("registration/clicked_frames", "registration/clicked_residual_m_median")


@dataclass(frozen=True)
class Clicked:
    """Cameras of one recording that were clicked."""

    frame: np.ndarray
    """[camera] extracted frame"""
    world_from_camera: Float[np.ndarray, "camera 4 4"]
    residual_m: Float[np.ndarray, "camera"]

    @property
    def trusted(self) -> Bool[np.ndarray, "camera"]:
        """Cameras whose clicks agree with each other."""
        return self.residual_m <= TRUSTED_M


def cameras_from_clicks(path: Path, folders: BuildFolders, videos: Sequence[Video]) -> dict[str, Clicked]:
    """Fit every clicked frame; by recording id. Raises EVA-001 for a broken file."""
    pairs = clicks.read(path)
    walkthrough = next(video for video in videos if video.role == "walkthrough")
    pairs = [pair for pair in pairs if pair.reference.recording == walkthrough.file]
    world_from_reference = SceneCameras.open(folders.scene_template).world_from_registered
    reference, found = ClickedClip.open(folders.frames[walkthrough.id]), {}
    for video in videos:
        groups = clicks.by_frame(pairs, video.file)
        if not groups:
            continue
        recorded, rows = ClickedClip.open(folders.frames[video.id]), []
        for group in groups.values():
            frame = recorded.frame_of(group[0].seen)
            fit = clicks.fit(group, recorded, reference, world_from_reference)
            if fit is not None and frame is not None:
                rows.append((frame, fit.world_from_camera, fit.typical_m))
        if rows:
            frame, poses, residual_m = zip(*rows, strict=True)
            found[video.id] = Clicked(np.array(frame), np.stack(poses), np.array(residual_m))
    return found


def clicked_metrics(
    cameras: Mapping[str, Clicked], folders: BuildFolders, videos: Sequence[Video]
) -> Metrics:
    """Compare registered cameras with clicked ones; a refused recording failed in every clicked frame."""
    metrics, errors, residual_m, left_out = Metrics(), [], [], 0
    for video in videos:
        if video.role != "session" or video.id not in cameras:
            continue
        clicked, poses = cameras[video.id], RegisteredPoses.open(folders.registration / video.id)
        trusted = clicked.trusted
        left_out += int((~trusted).sum())
        unknown = np.full((len(clicked.frame), 4, 4), np.nan)
        ours = unknown if poses is None else poses.world_from_camera[clicked.frame]
        errors.append(pose_errors(ours[trusted], clicked.world_from_camera[trusted]))
        residual_m.append(clicked.residual_m[trusted])
    every = joined(errors)
    if not len(every.degrees):
        why = NO_CLICKS
        if left_out:
            why = f"all {left_out} clicked frames disagree by more than {100 * TRUSTED_M:.0f} cm: click again"
        metrics.skip((*NAMES, *OWN_NAMES), why)
        return metrics
    put_cameras(metrics, every, "clicked frames")
    measured_by = (
        f"clicked correspondences in {len(every.degrees)} frames of "
        f"{len(errors)} sessions, {left_out} frames left out"
    )
    metrics.skip(["registration/measured_by"], measured_by)
    metrics.put("registration/clicked_frames", len(every.degrees))
    metrics.put("registration/clicked_residual_m_median", float(np.median(np.concatenate(residual_m))))
    return metrics


def all_cameras(
    clicked: Clicked, odometry_from_camera: Float[np.ndarray, "frame 4 4"] | None, count: int
) -> Float[np.ndarray, "frame 4 4"]:
    """Carry clicked cameras to all ``count`` frames by odometry; NaN elsewhere where there is none."""
    found = np.full((count, 4, 4), np.nan)
    trusted = clicked.trusted
    if odometry_from_camera is None or not trusted.any():
        found[clicked.frame[trusted]] = clicked.world_from_camera[trusted]
        return found
    each = clicked.world_from_camera[trusted] @ rigid.inverse(odometry_from_camera[clicked.frame[trusted]])
    middle = np.median(clicked.world_from_camera[trusted][:, :3, 3], axis=0)
    rotation = rigid.mean_rotation(each[:, :3, :3])
    # Rotate about where the cameras were, so that a small error of rotation does not swing far origins
    # around.
    there = rigid.apply(rigid.inverse(each), np.repeat(middle[None, None], len(each), axis=0))[:, 0].mean(0)
    return rigid.make(rotation, middle - rotation @ there) @ odometry_from_camera
