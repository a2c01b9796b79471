"""Write frames as the ``frames/<id>`` artifact and check their quality."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.core.errors import InputError
from pipeline.data import images, ply, qa
from pipeline.data.clips import FRAMES
from pipeline.mapping.picture_agreement import PictureAgreement
from pipeline.recordings import errors, extraction
from pipeline.recordings.extraction import DARK, MEASURED, RELATIVE, ExtractedFrame, ExtractionPlan
from pipeline.recordings.recording import Recording
from stages.extract_frames.config import Config

MAX_LOST = 0.5
"""maximum share of damaged pictures (0..1)"""
SHEET_FRAMES = 12
SHEET_HEIGHT_PX = 200


@dataclass(frozen=True)
class WrittenFrames:
    """Summary of the written frames."""

    usable: Bool[np.ndarray, "frame"]
    """which of the plan's frames have enough depth"""
    lost: float
    """share (0..1) of damaged frames"""
    sharpness: Float[np.ndarray, "usable_frame"]
    brightness: Float[np.ndarray, "usable_frame"]
    depth_valid: Float[np.ndarray, "usable_frame"]
    color_strip: UInt8[np.ndarray, "height width 3"]
    depth_strip: UInt8[np.ndarray, "height width 3"]


def write_frames(
    folder: Path, frames: Iterable[ExtractedFrame | None], config: Config, *, total: int, where: str
) -> WrittenFrames:
    """Write the frames that have enough depth, numbered without gaps.

    Raises CAP-007 when fewer than five have, CAP-001 when the file is damaged in more than half of them.
    """
    for name in ("color", "depth", "confidence"):
        (folder / name).mkdir()
    usable, lost, statistics, strip = np.zeros(total, bool), 0, [], []
    shown = set(np.linspace(0, total - 1, SHEET_FRAMES).astype(int).tolist())
    for number, frame in enumerate(frames):
        if frame is None:
            lost += 1
            continue
        if number in shown:
            strip.append((thumbnail(frame.color), thumbnail(_colored_depth(frame.depth))))
        if frame.depth_valid < config.min_depth_valid:
            continue
        name = f"{len(statistics):06d}"
        jpeg = frame.jpeg or images.encode_jpeg(frame.color, config.jpeg_quality)
        (folder / "color" / f"{name}.jpg").write_bytes(jpeg)
        images.write_depth(folder / "depth" / f"{name}.exr", frame.depth)
        images.write_gray(folder / "confidence" / f"{name}.png", frame.confidence)
        statistics.append((frame.sharpness, frame.brightness, frame.depth_valid))
        usable[number] = True
    if lost > MAX_LOST * total:
        raise errors.damaged(where, f"{lost} of {total} pictures cannot be decoded")
    if len(statistics) < extraction.MIN_FRAMES:
        known = f"{config.min_depth_valid:.0%} of the depth is known in {len(statistics)} of {total} frames"
        what = f"{known}; {extraction.MIN_FRAMES} are the least"
        remedy = "record some seconds at least, things within 5 m, in light, with the LiDAR camera"
        raise InputError("CAP-007", what, where, remedy)
    color_strip, depth_strip = (np.concatenate(pictures, axis=1) for pictures in zip(*strip, strict=True))
    sharpness, brightness, depth_valid = np.array(statistics).T
    return WrittenFrames(usable, lost / total, sharpness, brightness, depth_valid, color_strip, depth_strip)


def write_table(folder: Path, recording: Recording, plan: ExtractionPlan, written: WrittenFrames) -> None:
    """Write ``frames.npz`` for the usable frames and, with poses, ``mesh.ply``, the app's mesh."""
    usable = written.usable
    odometry = None if plan.odometry_from_camera is None else plan.odometry_from_camera[usable]
    FRAMES.save(
        folder / "frames.npz",
        timestamp_s=plan.timestamp_s[usable],
        intrinsics=plan.intrinsics[usable],
        depth_intrinsics=plan.depth_intrinsics[usable],
        odometry_from_camera=odometry,
        gravity_known=np.array(plan.gravity_known),
        scale=np.array(plan.scale),
        source_index=recording.index[plan.chosen][usable],
        quarter_turns=np.array(plan.quarter_turns),
        sharpness=written.sharpness,
        brightness=written.brightness,
        depth_valid=written.depth_valid,
        quality=extraction.quality_of(written.sharpness, written.brightness, written.depth_valid),
    )
    if recording.read_mesh is not None and odometry is not None:
        ply.write_ply(folder / "mesh.ply", recording.read_mesh())


def report_quality(
    folder: Path,
    recording: Recording,
    plan: ExtractionPlan,
    written: WrittenFrames,
    agreement: PictureAgreement | None,
    *,
    rate_hz: float,
) -> None:
    """Write the quality checks, the share of usable frames and a contact sheet."""
    timestamp_s = plan.timestamp_s[written.usable]
    duration_s = float(timestamp_s[-1] - timestamp_s[0])
    blurred = written.sharpness < extraction.BLURRED_SHARE * max(float(np.median(written.sharpness)), 1e-6)
    dropped = float((~written.usable).mean()) - written.lost
    with_poses = float(plan.odometry_from_camera is not None)
    missing = 1 - len(timestamp_s) / max(round(duration_s * rate_hz) + 1, 1)
    checks = [
        qa.Check("duration", duration_s, "s", warn=5.0, better="higher"),
        qa.Check("frames", float(len(timestamp_s)), "", warn=50, better="higher"),
        qa.Check("frames a second", (len(timestamp_s) - 1) / max(duration_s, 1e-6), "Hz"),
        qa.Check("missing ticks", 100 * missing, "%", warn=20.0),
        qa.Check("dark frames", 100 * float((written.brightness < DARK).mean()), "%", warn=20.0),
        qa.Check("blurred frames", 100 * float(blurred.mean()), "%", warn=25.0),
        qa.Check("known depth", 100 * float(written.depth_valid.mean()), "%", warn=50.0, better="higher"),
        qa.Check("frames dropped for lack of depth", 100 * dropped, "%", warn=10.0),
        qa.Check("damaged frames", 100 * written.lost, "%", warn=0.0),
        qa.Check("incomplete frames left out", 100 * recording.incomplete, "%", warn=2.0),
        qa.Check("clockwise quarter turns applied", float(plan.quarter_turns)),
        qa.Check("device poses usable", with_poses, "", warn=0.5, better="higher"),
        _check_of_poses(plan),
    ]
    if agreement is not None and agreement.verdict != "untested":
        agreeing = {"agree": 1.0, "unconfirmed": 0.5, "contradict": 0.0}[agreement.verdict]
        name = f"pictures against depth, intrinsics and poses ({agreement.reason})"
        checks.append(qa.Check(name, agreeing, "", warn=0.75, fail=0.25, better="higher"))
    pictures = [
        qa.Picture("contact_sheet", written.color_strip, "frames spread over the recording, as understood"),
        qa.Picture("depth_strip", written.depth_strip, "their depth, near is bright, black is unknown"),
    ]
    qa.write(
        folder,
        good="upright pictures, depth that follows their edges, device poses within 15 mm of the depth",
        bad="sideways or black pictures, mostly black depth, device poses missing",
        checks=checks,
        pictures=pictures,
    )


def _check_of_poses(plan: ExtractionPlan) -> qa.Check:
    """Return the check of device poses against depth or, for a map from pictures, of its scale."""
    check = plan.pose_check
    if plan.scale != MEASURED:
        relative = plan.scale == RELATIVE
        scale = "relative: lengths are no meters" if relative else f"meters from the depth of {plan.scale}"
        name = f"scale known ({check.reason}; {scale})"
        return qa.Check(name, float(not relative), "", warn=0.5, better="higher")
    residual_mm = 1000 * check.residual_m if check.verdict in ("documented", "other") else None
    name = f"device poses against depth ({check.reason})"
    return qa.Check(name, residual_mm, "mm", warn=1000 * check.tolerance_m)


def thumbnail(image: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "_ _ 3"]:
    """Reduce a picture to the height of a contact sheet."""
    width = max(round(image.shape[1] * SHEET_HEIGHT_PX / image.shape[0]), 1)
    return cv2.resize(image, (width, SHEET_HEIGHT_PX), interpolation=cv2.INTER_AREA)


def _colored_depth(depth: Float[np.ndarray, "height width"]) -> UInt8[np.ndarray, "_ _ 3"]:
    nearness = np.clip(255 * (1 - depth / max(float(depth.max()), 1e-3)), 0, 255).astype(np.uint8)
    colored = cv2.applyColorMap(nearness, cv2.COLORMAP_INFERNO)[..., ::-1]
    return np.ascontiguousarray(np.where(depth[..., None] > 0, colored, 0).astype(np.uint8))
