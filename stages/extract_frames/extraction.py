"""From a recording to upright frames at a steady rate: first understand the whole, then read picture by picture.

`understand` costs a second and reads a dozen depth pictures; `frames` then yields one `Frame` at a time.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.errors import InputError
from pipeline.files import images
from pipeline.space import cameras
from stages.extract_frames import conventions
from stages.extract_frames.conventions import SelfCheck
from stages.extract_frames.record3d import Recording
from stages.extract_frames.selection import choose_frames
from stages.extract_frames.upright import quarter_turns_from_gravity

SHARPNESS_WIDTH_PX = 240
DARK = 0.15
"""mean brightness (0..1) below which a picture loses quality"""


@dataclass(frozen=True)
class Plan:
    """What was understood of a recording; ``chosen`` indexes the recording's frames, everything else is upright."""

    chosen: Int[np.ndarray, "frame"]
    timestamp_s: Float[np.ndarray, "frame"]
    stored_size: tuple[int, int]
    """(height, width) of the colour pictures before the turn"""
    intrinsics: Float[np.ndarray, "frame 3 3"]
    """colour pixels"""
    depth_intrinsics: Float[np.ndarray, "frame 3 3"]
    odometry_from_camera: Float[np.ndarray, "frame 4 4"] | None
    gravity_known: bool
    quarter_turns: int
    """clockwise, stored to upright"""
    self_check: SelfCheck


@dataclass(frozen=True)
class Frame:
    """One upright frame."""

    color: UInt8[np.ndarray, "height width 3"]
    jpeg: bytes
    """the phone's own bytes where the picture is kept as it is"""
    depth: Float[np.ndarray, "height width"]
    """metres, 0 = unknown"""
    confidence: UInt8[np.ndarray, "height width"]
    """0 low, 1 medium, 2 high"""
    sharpness: float
    """standard deviation of the Laplacian of the picture at a common width"""
    brightness: float
    """mean, 0..1"""
    depth_valid: float
    """share of known depth"""


def understand(recording: Recording, *, rate_hz: float, max_depth_m: float, pairs: int, max_side_px: int) -> Plan:
    """Choose frames, check the poses on the depth, find the upright turn and the size of the pictures."""
    depth_intrinsics = cameras.scale_intrinsics(recording.intrinsics, recording.color_size, recording.depth_size)

    def view(frame: int) -> conventions.DepthView:
        depth = known_depth(recording.read_depth(int(recording.index[frame])), max_depth_m)
        return conventions.DepthView(depth, depth_intrinsics[frame])

    check = conventions.check_poses(recording.pose, recording.timestamp_s, view, pairs)
    odometry_from_camera, gravity_known, turns = None, False, 0
    if check.verdict != "unusable":
        odometry_from_camera = conventions.odometry_from_pose(recording.pose, check.convention)
        gravity_known = not conventions.starts_at_identity(recording.pose, check.convention)
        turns = quarter_turns_from_gravity(odometry_from_camera) if gravity_known else 0
        odometry_from_camera = cameras.turn_camera(odometry_from_camera, turns)
    size = reduced_size(recording.color_size, max_side_px)
    intrinsics = cameras.scale_intrinsics(recording.intrinsics, recording.color_size, size)
    chosen = choose_frames(recording.timestamp_s, rate_hz)
    return Plan(
        chosen=chosen,
        timestamp_s=recording.timestamp_s[chosen],
        stored_size=size,
        intrinsics=cameras.turn_intrinsics(intrinsics, size, turns)[chosen],
        depth_intrinsics=cameras.turn_intrinsics(depth_intrinsics, recording.depth_size, turns)[chosen],
        odometry_from_camera=None if odometry_from_camera is None else odometry_from_camera[chosen],
        gravity_known=gravity_known,
        quarter_turns=turns,
        self_check=check,
    )


def frames(recording: Recording, plan: Plan, *, max_depth_m: float, jpeg_quality: int) -> Iterator[Frame]:
    """Yield the plan's frames in order, upright. Raises InputError for pictures that cannot be decoded."""
    for number in recording.index[plan.chosen]:
        jpeg = recording.read_color(int(number))
        color = _decoded(jpeg, recording.color_size, f"{recording.where}, frame {number}")
        depth = known_depth(recording.read_depth(int(number)), max_depth_m)
        confidence = _confidence(recording, int(number), depth)
        if color.shape[:2] != plan.stored_size:
            color = cv2.resize(color, plan.stored_size[::-1], interpolation=cv2.INTER_AREA)
        if plan.quarter_turns:
            color, depth, confidence = (cameras.turn_image(image, plan.quarter_turns) for image in (color, depth, confidence))
        if plan.quarter_turns or plan.stored_size != recording.color_size:
            jpeg = images.encode_jpeg(color, jpeg_quality)
        sharpness, brightness = picture_statistics(color)
        yield Frame(color, jpeg, depth, confidence, sharpness, brightness, float((depth > 0).mean()))


def _decoded(jpeg: bytes, size: tuple[int, int], where: str) -> UInt8[np.ndarray, "height width 3"]:
    color = images.decode_color(jpeg, where)
    if color.shape[:2] != size:
        what = f"the picture is {color.shape[1]} x {color.shape[0]}, the metadata say {size[1]} x {size[0]}"
        raise InputError("CAP-004", what=what, where=where, remedy="export the recording again")
    return color


def _confidence(recording: Recording, number: int, depth: np.ndarray) -> UInt8[np.ndarray, "height width"]:
    """Return the phone's confidence; an export without it trusts all depth that there is."""
    if recording.read_confidence is None:
        return np.where(depth > 0, 2, 0).astype(np.uint8)
    return np.minimum(recording.read_confidence(number), 2)


def reduced_size(size: tuple[int, int], max_side_px: int) -> tuple[int, int]:
    """Divide a (height, width) by the smallest whole number that brings the longer side to ``max_side_px``."""
    factor = -(-max(size) // max_side_px)
    return (round(size[0] / factor), round(size[1] / factor))


def known_depth(depth: Float[np.ndarray, "height width"], max_depth_m: float) -> Float[np.ndarray, "height width"]:
    """Return depth in metres with 0 where it is not finite, not positive or beyond the sensor's range."""
    return np.where(np.isfinite(depth) & (depth > 0) & (depth < max_depth_m), depth, np.float32(0))


def picture_statistics(color: UInt8[np.ndarray, "height width 3"]) -> tuple[float, float]:
    """Return (sharpness, brightness 0..1) of a picture; sharpness is measured at a common width."""
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    scale = SHARPNESS_WIDTH_PX / gray.shape[1]
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else gray
    return float(cv2.Laplacian(small, cv2.CV_32F).std()), float(gray.mean() / 255)


def quality_of(
    sharpness: Float[np.ndarray, "frame"],
    brightness: Float[np.ndarray, "frame"],
    depth_valid: Float[np.ndarray, "frame"],
) -> Float[np.ndarray, "frame"]:
    """Return 0..1 per frame: how sharp it is for its recording, whether it is lit, how much depth it has."""
    sharp = np.minimum(sharpness / max(float(np.median(sharpness)), 1e-6), 1)
    return sharp * np.minimum(brightness / DARK, 1) * depth_valid


def sentence(recording: Recording, plan: Plan) -> str:
    """Say in one line what was understood of a recording."""
    seconds = recording.timestamp_s[-1] - recording.timestamp_s[0]
    height, width = recording.color_size
    turned = f"turned {90 * plan.quarter_turns} deg clockwise" if plan.quarter_turns else "upright as stored"
    seen = f"{seconds:.1f} s, {len(recording.index)} frames {width} x {height}, {len(plan.chosen)} kept, {turned}"
    check = plan.self_check
    measured = f" ({1000 * check.residual_m:.1f} mm)" if np.isfinite(check.residual_m) else ""
    return f"{recording.where}: {seen}; {check.reason}{measured}"
