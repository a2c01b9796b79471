"""Poses, intrinsics and depth of a video without depth, filmed in a static room.

Keyframes (`structure`) are posed by COLMAP, `plane_sweep` gives depth, `scaling` meters where a recording
with depth shows the same room. Keyframes that were not registered are left out and reported.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Int, UInt8

from pipeline.core.errors import InputError
from pipeline.core.progress import track
from pipeline.data import images
from pipeline.geometry import cameras
from pipeline.mapping import plane_sweep, sift
from pipeline.mapping.colmap import SparseModel
from pipeline.mapping.plane_sweep import SweepView
from pipeline.recordings import extraction, upright
from pipeline.recordings.conventions import OPENCV, PoseCheck
from pipeline.recordings.extraction import ExtractedFrame, ExtractionPlan, choose_frames
from pipeline.recordings.recording import Recording
from stages.extract_frames import scaling, structure
from stages.extract_frames.config import Config, PhotogrammetryConfig
from stages.extract_frames.scaling import MeasuredRecording
from stages.extract_frames.structure import Structure

LISTED = 12
"""maximum number of lost pictures named in the log"""
MIN_AGREEING = 2
"""minimum number of consistent views of a depth; one more makes it of high confidence"""
MIN_MAPPED = 0.3
"""minimum share of keyframes in the largest model"""
TYPICAL_DEPTH_M = 2.0
"""median depth to which a model without metric scale is scaled: a room's, meters"""
SEED = 0
"""seed for COLMAP"""
KEYFRAME_JPEG_QUALITY = 98
"""JPEG quality of COLMAP's keyframes, visually lossless"""


def map_pictures(
    recording: Recording, measured: Mapping[str, MeasuredRecording], settings: Config, workspace: Path
) -> tuple[ExtractionPlan, Iterator[ExtractedFrame], str]:
    """Map a video without depth: plan, frames and a sentence about them. Raises MAP-004.

    ``measured`` recordings, by id, may supply metric scale.
    """
    config, max_depth_m = settings.without_depth, settings.max_depth_m
    size = extraction.reduced_size(recording.color_size, settings.max_side_px)
    rows = _write_keyframes(recording, size, settings.rate_hz, config, workspace / "pictures")
    solved = _solved(recording, rows, size, config, workspace)
    sparse = solved.sparse
    pictures = [_undistorted(workspace / "pictures" / f"{row:06d}.jpg", solved) for row in sparse.frame]
    grays = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures]
    views = [
        SweepView.resized(gray, solved.intrinsics, pose, config.depth_side_px)
        for gray, pose in zip(grays, sparse.model_from_camera, strict=True)
    ]
    depth, confidence = _depths(views, sparse, config)
    unit_m, scale = _unit_m(solved, grays, views, depth, measured)
    depth = [np.where(each * unit_m < max_depth_m, each * unit_m, 0).astype(np.float32) for each in depth]
    world_from_camera = sparse.model_from_camera.copy()
    world_from_camera[:, :3, 3] *= unit_m
    views_m = [(each, view.intrinsics) for each, view in zip(depth, views, strict=True)]
    turns = recording.quarter_turns or upright.quarter_turns_from_room(world_from_camera, views_m)
    intrinsics = cameras.turn_intrinsics(solved.intrinsics, size, turns)
    depth_intrinsics = [cameras.turn_intrinsics(view.intrinsics, view.gray.shape, turns) for view in views]
    plan = ExtractionPlan(
        chosen=sparse.frame,
        timestamp_s=recording.timestamp_s[sparse.frame],
        stored_size=size,
        intrinsics=np.repeat(intrinsics[None], len(views), axis=0),
        depth_intrinsics=np.stack(depth_intrinsics),
        odometry_from_camera=cameras.turn_camera(world_from_camera, turns),
        gravity_known=False,
        quarter_turns=turns,
        pose_check=PoseCheck("untested", OPENCV, "poses and depth from the pictures alone"),
        scale=scale,
    )
    upright_frames = zip(pictures, depth, confidence, strict=True)
    frames = (_frame(*each, turns) for each in upright_frames)
    return plan, frames, _summary(recording, rows, solved, scale)


def _write_keyframes(
    recording: Recording, size: tuple[int, int], rate_hz: float, config: PhotogrammetryConfig, folder: Path
) -> Int[np.ndarray, "key"]:
    """Write the keyframes as ``<row in the recording>.jpg`` and return their rows."""
    folder.mkdir()
    steps, last, rows, sharpness = [], None, [], []
    for row in track(choose_frames(recording.timestamp_s, rate_hz).tolist(), "looking at pictures"):
        color = extraction.picture(recording, row, size)
        if color is not None:
            before, last = last, structure.motion_picture(color)
            steps.append(0.0 if before is None else structure.motion(before, last))
            rows.append(row)
            sharpness.append(extraction.picture_statistics(color)[0])
    if len(rows) < structure.MIN_KEYFRAMES:
        raise no_map(recording, f"only {len(rows)} pictures can be read")
    keys = structure.choose_keyframes(np.cumsum(steps), np.array(sharpness), config)
    chosen = np.array(rows)[keys]
    for row in chosen.tolist():
        color = extraction.picture(recording, row, size)
        assert color is not None, "a picture that could be read before"
        (folder / f"{row:06d}.jpg").write_bytes(images.encode_jpeg(color, KEYFRAME_JPEG_QUALITY))
    return chosen


def _solved(
    recording: Recording,
    rows: Int[np.ndarray, "key"],
    size: tuple[int, int],
    config: PhotogrammetryConfig,
    workspace: Path,
) -> Structure:
    if len(rows) < structure.MIN_KEYFRAMES:
        raise no_map(recording, "the camera hardly moves")
    known = recording.intrinsics
    if known is not None:
        known = np.median(cameras.scale_intrinsics(known, recording.color_size, size), axis=0)
    names = [f"{row:06d}.jpg" for row in rows]
    solved = structure.solve(workspace / "pictures", names, known, config, workspace, SEED)
    if solved is None:
        raise no_map(recording, "its pictures do not fit together to one model")
    if len(solved.sparse.frame) < MIN_MAPPED * len(rows):
        raise no_map(recording, f"its largest model holds {len(solved.sparse.frame)} of {len(rows)} pictures")
    return solved


def no_map(recording: Recording, why: str) -> InputError:
    """Return the error for pictures that cannot be mapped."""
    remedy = "walk sideways, slowly, in good light, do not turn on the spot; or record with a LiDAR phone"
    return InputError("MAP-004", f"no map can be made from pictures alone: {why}", recording.where, remedy)


def _undistorted(path: Path, solved: Structure) -> UInt8[np.ndarray, "height width 3"]:
    centered = solved.intrinsics.copy()
    centered[:2, 2] -= 0.5
    return cv2.undistort(images.read_color(path), centered, np.array([solved.radial, 0, 0, 0]))


def _depths(
    views: list[SweepView], sparse: SparseModel, config: PhotogrammetryConfig
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return depth (model units, 0 = unknown) and confidence (0..2) of every view."""
    others = plane_sweep.source_views(sparse, config.depth_sources)
    bounds = [plane_sweep.depth_range(sparse, key) for key in range(len(views))]
    depth, confidence = [], []
    for swept, agree in plane_sweep.depths(views, others, bounds, config.depth_planes):
        depth.append(np.where(agree >= MIN_AGREEING, swept, 0))
        confidence.append(np.clip(agree.astype(int) - MIN_AGREEING + 1, 0, 2).astype(np.uint8))
    return depth, confidence


def _unit_m(
    solved: Structure,
    grays: list[np.ndarray],
    views: list[SweepView],
    depth: list[np.ndarray],
    measured: Mapping[str, MeasuredRecording],
) -> tuple[float, str]:
    """Return meters per unit of the model, and the id of the recording that gave them, or `relative`."""
    mapped = [
        sift.lift(sift.describe(picture, scaling.POINTS), solved.intrinsics, each, view.intrinsics)
        for picture, view, each in zip(grays, views, depth, strict=True)
        if measured
    ]
    for name, other in measured.items():
        unit_m = scaling.meters_per_unit(mapped, other, SEED)
        if unit_m is not None:
            return unit_m, name
    known = np.concatenate([each[each > 0] for each in depth])
    return TYPICAL_DEPTH_M / float(np.median(known)) if len(known) else 1.0, extraction.RELATIVE


def _frame(picture: np.ndarray, depth: np.ndarray, confidence: np.ndarray, turns: int) -> ExtractedFrame:
    confidence = np.where(depth > 0, confidence, 0).astype(np.uint8)
    color, depth, confidence = (cameras.turn_image(image, turns) for image in (picture, depth, confidence))
    statistics = extraction.picture_statistics(color)
    return ExtractedFrame(color, None, depth, confidence, *statistics, float((depth > 0).mean()))


def _summary(recording: Recording, rows: np.ndarray, solved: Structure, scale: str) -> str:
    lost = np.setdiff1d(rows, solved.sparse.frame)
    seconds = ", ".join(f"{recording.timestamp_s[row]:.1f}" for row in lost[:LISTED])
    left_out = f"; {len(lost)} were not registered, at {seconds}{' ...' if len(lost) > LISTED else ''} s"
    split = f", the largest of {solved.models} models" if solved.models > 1 else ""
    relative = "the scale is relative: lengths are no meters"
    meters = relative if scale == extraction.RELATIVE else f"meters from the depth of {scale}"
    focal_source = "given" if recording.intrinsics is not None else "calibrated"
    mapped = f"mapped from {len(solved.sparse.frame)} of {len(rows)} pictures{split}"
    lens = f"focal length {solved.intrinsics[0, 0]:.0f} px ({focal_source})"
    reprojection = f"reprojection {solved.sparse.reprojection_px:.2f} px"
    mapped += left_out if len(lost) else ""
    return f"{recording.where}: {recording.kind}, {mapped}; {lens}, {reprojection}; {meters}"
