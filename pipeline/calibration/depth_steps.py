"""Outlines of nearer surfaces in depth, and the picture's edges across each of them.

Every point of an outline gets the profile of the picture's gradient along its normal, and the derivatives of
its position along that normal by the parameters of the depth camera (`PARAMETERS`).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

from pipeline.geometry import cameras, rigid
from pipeline.geometry.subsampling import evenly
from pipeline.mapping.edge_agreement import STEP_M, STEP_SHARE

PARAMETERS = ("focal", "x", "y", "pitch", "yaw", "roll", "delay", "margin")
"""relative change of the depth camera's focal length; translation from the color to the depth camera, meters;
rotation of what the latter sees, radians; seconds by which depth is older than the picture; and distance of
measured outlines from edges of pictures, pixels, which is no property of the camera
"""
REACH_SHARE = 1 / 16
"""length of a profile to both sides, share of the picture's longer side"""
INNER_PX, MARGIN_PX = 3.0, 3
"""the motion of an outline is read this far inside of it; depth near the border is not used"""
BLUR_PX = 1.5
"""blur of inverse depth before its gradient gives normals"""
POINTS = 500
"""maximum points per frame, evenly spread"""
NEAREST_M = 0.05
MIN_POINTS = 30
"""minimum points of a frame"""
MIN_SEEN = 0.5
"""minimum share of a profile inside the picture"""


@dataclass(frozen=True)
class StepFrame:
    """A picture with the depth that was stored for it, or a later or earlier one."""

    slopes: Float[np.ndarray, "height width 2"]
    """`edge_agreement.relative_slopes` of the picture"""
    intrinsics: Float[np.ndarray, "3 3"]
    flow_px_s: Float[np.ndarray, "height width 2"]
    """motion of the picture, pixels per second"""
    depth: Float[np.ndarray, "depth_height depth_width"]
    """meters, 0 = unknown, as the depth camera sees it"""
    depth_intrinsics: Float[np.ndarray, "3 3"]
    later_s: float = 0.0
    """time of the depth minus time of the picture, as stored"""


@dataclass(frozen=True)
class StepProfiles:
    """Points on outlines of many frames."""

    gradient: Float[np.ndarray, "point offset"]
    """across each outline, relative to the neighborhood, zero mean; every pixel, the point in the middle"""
    derivative: Float[np.ndarray, "point parameter"]
    """of the position along the normal, pixels per unit of each of `PARAMETERS`"""
    frame: Int[np.ndarray, "point"]


def profiles(
    frames: list[StepFrame], color_from_depth: Float[np.ndarray, "4 4"], delay_s: float
) -> StepProfiles:
    """Sample pictures across outlines as a depth camera sees them whose depth is ``delay_s`` old.

    Frames with few outlines are left out.
    """
    found = []
    for number, frame in enumerate(frames):
        pixel, depth, normal = outlines(frame.depth)
        if len(pixel) >= MIN_POINTS:
            rays = cameras.unproject(pixel, frame.depth_intrinsics)
            points = rigid.apply(color_from_depth, rays * depth[:, None])
            ahead = points[:, 2] > NEAREST_M
            gradient, derivative = _across(frame, points[ahead], normal[ahead], delay_s - frame.later_s)
            found.append((gradient, derivative, np.full(len(gradient), number)))
    if not found:
        return StepProfiles(np.zeros((0, 1)), np.zeros((0, len(PARAMETERS))), np.zeros(0, int))
    return StepProfiles(*(np.concatenate(each) for each in zip(*found, strict=True)))


def outlines(
    depth: Float[np.ndarray, "height width"],
) -> tuple[Float[np.ndarray, "point 2"], Float[np.ndarray, "point"], Float[np.ndarray, "point 2"]]:
    """Return pixels where a surface ends before a farther one, its depth, and normals toward the farther one.

    Unknown depth in between, such as a projector's shadow, counts as the farther one.
    """
    known, filled = depth > 0, _filled(depth)
    far = cv2.dilate(filled, np.ones((3, 3), np.uint8))
    step = known & (far > filled * (1 + STEP_SHARE) + STEP_M)
    inside = np.zeros_like(step)
    inside[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX] = True
    inverse = np.where(filled > 0, 1 / np.maximum(filled, NEAREST_M), 0).astype(np.float32)
    inverse = cv2.GaussianBlur(inverse, (0, 0), BLUR_PX)
    x, y = cv2.Sobel(inverse, cv2.CV_32F, 1, 0), cv2.Sobel(inverse, cv2.CV_32F, 0, 1)
    steepness = np.hypot(x, y)
    row, column = np.nonzero(step & inside & (steepness > 0))
    chosen = evenly(len(row), POINTS)
    row, column = row[chosen], column[chosen]
    normal = -np.stack([x[row, column], y[row, column]], axis=-1) / steepness[row, column, None]
    return cameras.pixel_centers(row, column) + 0.5 * normal, depth[row, column], normal


def _filled(depth: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Fill unknown depth with the farther of the next known values to the left and to the right."""
    known, column = depth > 0, np.arange(depth.shape[1])
    left = np.maximum.accumulate(np.where(known, column, 0), axis=1)
    right = np.minimum.accumulate(np.where(known, column, len(column) - 1)[:, ::-1], axis=1)[:, ::-1]
    farther = np.maximum(*(np.take_along_axis(depth, each, axis=1) for each in (left, right)))
    return np.where(known, depth, farther)


def _across(
    frame: StepFrame,
    points_color: Float[np.ndarray, "point 3"],
    normal: Float[np.ndarray, "point 2"],
    delay_s: float,
) -> tuple[Float[np.ndarray, "used offset"], Float[np.ndarray, "used parameter"]]:
    """Return profiles of the picture across outlines, and derivatives, of those inside the picture."""
    pixel, z = cameras.project(points_color, frame.intrinsics)
    motion = _read(frame.flow_px_s, (pixel - INNER_PX * normal)[:, None])[:, 0]
    pixel = pixel + delay_s * motion
    reach = round(REACH_SHARE * max(frame.slopes.shape[:2]))
    at = pixel[:, None] + np.arange(-reach, reach + 1)[:, None] * normal[:, None]
    slopes = np.abs(_dot(_read(frame.slopes, at), normal[:, None]))
    height, width = frame.slopes.shape[:2]
    seen = (at[..., 0] >= MARGIN_PX) & (at[..., 0] < width - MARGIN_PX)
    seen &= (at[..., 1] >= MARGIN_PX) & (at[..., 1] < height - MARGIN_PX)
    used = seen[:, reach] & (seen.mean(1) > MIN_SEEN)
    mean = (slopes * seen).sum(1, keepdims=True) / np.maximum(seen.sum(1, keepdims=True), 1)
    (fx, fy), center = frame.intrinsics[[0, 1], [0, 1]], frame.intrinsics[:2, 2]
    x, y = ((pixel - center) / (fx, fy)).T
    none = np.zeros_like(x)
    rows = [
        center - pixel,
        np.stack([-fx / z, none], axis=-1),
        np.stack([none, -fy / z], axis=-1),
        np.stack([-fx * x * y, -fy * (1 + y**2)], axis=-1),
        np.stack([fx * (1 + x**2), fy * x * y], axis=-1),
        np.stack([-fx * y, fy * x], axis=-1),
        motion,
        normal,
    ]
    derivative = np.stack([_dot(row, normal) for row in rows], axis=-1)
    return np.where(seen, slopes - mean, 0)[used], derivative[used]


def _dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return first[..., 0] * second[..., 0] + first[..., 1] * second[..., 1]


def _read(
    image: Float[np.ndarray, "height width 2"], pixel: Float[np.ndarray, "point offset 2"]
) -> Float[np.ndarray, "point offset 2"]:
    x, y = (pixel[..., axis].astype(np.float32) - np.float32(0.5) for axis in (0, 1))
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
