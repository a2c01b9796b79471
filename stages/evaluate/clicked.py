"""Registration against clicked correspondences: what a real capture has in place of truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.files import arrays, clicks
from pipeline.files.clicks import Recorded
from pipeline.space import rigid
from pipeline.videos import Video
from stages.evaluate import reading
from stages.evaluate.alignment import PoseErrors, joined, pose_errors
from stages.evaluate.figures import Figures, median, percentile
from stages.evaluate.reading import Folders

TRUSTED_M = 0.10
"""frames whose clicks disagree by more than this are left out, metres"""
NO_CLICKS = "the true poses of this capture are not known; click some with `make annotate`"
NAMES = tuple(f"registration/{unit}_{which}" for unit in ("rotation_deg", "translation_m") for which in ("median", "p95"))
OWN_NAMES = ("registration/clicked_frames", "registration/clicked_residual_m_median")


@dataclass(frozen=True)
class Clicked:
    """Cameras of one recording that were clicked."""

    frame: np.ndarray
    """[camera] extracted frame"""
    world_from_camera: Float[np.ndarray, "camera 4 4"]
    residual_m: Float[np.ndarray, "camera"]

    @property
    def trusted(self) -> np.ndarray:
        """[camera] whose clicks agree with each other."""
        return self.residual_m <= TRUSTED_M


def cameras_from_clicks(path: Path, folders: Folders, videos: Sequence[Video]) -> dict[str, Clicked]:
    """Fit every clicked frame; by recording id. Raises EVA-001 for a broken file."""
    pairs = clicks.read(path)
    walkthrough = next(video for video in videos if video.role == "walkthrough")
    pairs = [pair for pair in pairs if pair.reference.recording == walkthrough.file]
    table = arrays.load(folders.scene_template / "cameras.npz", ("world_from_camera", "registered"))
    world_from_reference = np.where(table["registered"][:, None, None], table["world_from_camera"], np.nan)
    reference, found = Recorded.open(folders.frames[walkthrough.id]), {}
    for video in videos:
        groups = clicks.by_frame(pairs, video.file)
        if not groups:
            continue
        recorded, rows = Recorded.open(folders.frames[video.id]), []
        for group in groups.values():
            frame, fit = recorded.frame_of(group[0].seen), clicks.fit(group, recorded, reference, world_from_reference)
            if fit is not None and frame is not None:
                rows.append((frame, fit.world_from_camera, fit.typical_m))
        if rows:
            frame, poses, residual_m = zip(*rows, strict=True)
            found[video.id] = Clicked(np.array(frame), np.stack(poses), np.array(residual_m))
    return found


def clicked_figures(cameras: Mapping[str, Clicked], folders: Folders, videos: Sequence[Video]) -> Figures:
    """Compare registered cameras with clicked ones; a refused recording counts as failed in every clicked frame."""
    figures, errors, residual_m, left_out = Figures(), [], [], 0
    for video in videos:
        if video.role != "session" or video.id not in cameras:
            continue
        clicked, poses = cameras[video.id], reading.read_registration(folders.registration, video.id)
        kept = clicked.trusted
        left_out += int((~kept).sum())
        unknown = np.full((len(clicked.frame), 4, 4), np.nan)
        ours = unknown if poses is None else poses["world_from_camera"][clicked.frame]
        errors.append(pose_errors(ours[kept], clicked.world_from_camera[kept]))
        residual_m.append(clicked.residual_m[kept])
    every: PoseErrors = joined(errors)
    if not len(every.degrees):
        why = f"all {left_out} clicked frames disagree by more than {100 * TRUSTED_M:.0f} cm: click again" if left_out else NO_CLICKS
        figures.skip((*NAMES, *OWN_NAMES), why)
        return figures
    for unit, values in (("rotation_deg", every.degrees), ("translation_m", every.meters)):
        figures.put(f"registration/{unit}_median", median(values), "more than half of the clicked frames have no pose")
        figures.put(f"registration/{unit}_p95", percentile(values, 95), "a twentieth of the clicked frames has no pose")
    told = f"clicked correspondences in {len(every.degrees)} frames of {len(errors)} sessions, {left_out} frames left out"
    figures.skip(["registration/measured_by"], told)
    figures.put("registration/clicked_frames", len(every.degrees))
    figures.put("registration/clicked_residual_m_median", float(np.median(np.concatenate(residual_m))))
    return figures


def all_cameras(
    clicked: Clicked, odometry_from_camera: Float[np.ndarray, "frame 4 4"] | None, count: int
) -> Float[np.ndarray, "frame 4 4"]:
    """Carry clicked cameras to all ``count`` frames by odometry; NaN elsewhere where there is none."""
    found = np.full((count, 4, 4), np.nan)
    kept = clicked.trusted
    if odometry_from_camera is None or not kept.any():
        found[clicked.frame[kept]] = clicked.world_from_camera[kept]
        return found
    each = clicked.world_from_camera[kept] @ rigid.inverse(odometry_from_camera[clicked.frame[kept]])
    middle = np.median(clicked.world_from_camera[kept][:, :3, 3], axis=0)
    rotation = rigid.mean_rotation(each[:, :3, :3])
    # Rotate about where the cameras were, so that a small error of rotation does not swing far origins around.
    there = rigid.apply(rigid.inverse(each), np.repeat(middle[None, None], len(each), axis=0))[:, 0].mean(0)
    return rigid.make(rotation, middle - rotation @ there) @ odometry_from_camera
