"""Free space: a point that other frames saw through is not part of the still room.

`References` keeps a fixed number of depth pictures spread over the recording, before and after any frame, so that an
animal that rests for a while is told by the times when its place was empty. Votes cost O(references) a frame.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numba
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.files.clips import Clip
from pipeline.space import cameras, rigid


@dataclass(frozen=True)
class FreeSpace:
    """How other frames judge a point."""

    references: int = 90
    """depth pictures that vote, spread evenly over the recording"""
    margin_m: float = 0.05
    """a surface must lie this far behind a point to prove it free"""
    margin_share: float = 0.015
    """the same as a share of the distance, added"""
    drift_m: float = 0.015
    """pose error that is tolerated across the line of sight"""


@dataclass(frozen=True)
class References:
    """Depth pictures that vote; ``nearest`` is the smallest depth in a neighbourhood, which tolerates drift at edges."""

    camera_from_world: Float[np.ndarray, "reference 4 4"]
    intrinsics: Float[np.ndarray, "reference 3 3"]
    depth: Float[np.ndarray, "reference height width"]
    nearest: Float[np.ndarray, "reference height width"]
    color: UInt8[np.ndarray, "reference height width 3"]
    frame: Int[np.ndarray, "reference"]


@dataclass(frozen=True)
class Votes:
    """Per point: references that saw through it, references that saw a surface there, and the mean gap to that surface."""

    free: Int[np.ndarray, "*shape"]
    occupied: Int[np.ndarray, "*shape"]
    gap_m: Float[np.ndarray, "*shape"]
    """how far the references' surfaces lie behind the point, mean over those that agree within the margin"""
    color: Float[np.ndarray, "*shape 3"]
    """mean colour (0..255) of those surfaces"""


def usable_depth(clip: Clip, frame: int) -> Float[np.ndarray, "height width"]:
    """Read depth without low-confidence pixels and without flying pixels at depth steps (0 = unknown)."""
    depth = clip.depth(frame)
    low = cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), np.ones((3, 3), np.uint8))
    high = cv2.dilate(depth, np.ones((3, 3), np.uint8))
    return np.where((clip.confidence(frame) > 0) & (high - low < 0.25 * depth), depth, 0).astype(np.float32)


def gather(clip: Clip, world_from_camera: Float[np.ndarray, "frame 4 4"], options: FreeSpace) -> References:
    """Read the depth pictures that vote."""
    frames = np.unique(np.linspace(0, len(clip) - 1, min(options.references, len(clip))).round().astype(int))
    depth = np.stack([usable_depth(clip, frame) for frame in frames])
    nearest = np.stack(
        [_nearest(picture, clip.depth_intrinsics[frame, 0, 0], options) for picture, frame in zip(depth, frames, strict=True)]
    )
    color = np.stack([soft_color(clip.color(frame), clip.depth_size) for frame in frames])
    return References(rigid.inverse(world_from_camera[frames]), clip.depth_intrinsics[frames], depth, nearest, color, frames)


def without(references: References, hidden: Callable[[int], Bool[np.ndarray, "height width"]], free: FreeSpace) -> References:
    """Forget what references saw where ``hidden`` (at any resolution) says so: there, they no longer know a surface."""
    size = references.depth.shape[1:][::-1]
    depth = references.depth.copy()
    for row, frame in enumerate(references.frame):
        depth[row][cv2.resize(hidden(int(frame)).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0] = 0
    nearest = [_nearest(picture, k[0, 0], free) for picture, k in zip(depth, references.intrinsics, strict=True)]
    return replace(references, depth=depth, nearest=np.stack(nearest))


def soft_color(color: UInt8[np.ndarray, "height width 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "new_height new_width 3"]:
    """Resize to (height, width) and blur a little, so that colours compare in spite of small pose errors."""
    return cv2.GaussianBlur(cv2.resize(color, size[::-1], interpolation=cv2.INTER_AREA), (5, 5), 1.2)


def vote(references: References, points_world: Float[np.ndarray, "*shape 3"], options: FreeSpace, frame: int) -> Votes:
    """Let all references but the frame itself judge points (world, metres; NaN gets no vote)."""
    known = np.isfinite(points_world[..., 0])
    points = np.ascontiguousarray(points_world[known], np.float32)
    other = np.flatnonzero((references.frame != frame) & _looking_at(references, points))
    pinhole = references.intrinsics[:, [0, 1, 0, 1], [0, 1, 2, 2]].astype(np.float32)
    judged = _vote(
        points,
        other,
        references.camera_from_world.astype(np.float32),
        pinhole,
        references.depth,
        references.nearest,
        references.color,
        np.float32(options.margin_m),
        np.float32(options.margin_share),
    )
    votes = [np.zeros(known.shape + values.shape[1:], values.dtype) for values in judged]
    for whole, values in zip(votes, judged, strict=True):
        whole[known] = values
    return Votes(*votes)


def _looking_at(references: References, points_world: Float[np.ndarray, "point 3"], probes: int = 96) -> Bool[np.ndarray, "reference"]:
    """Tell which references have any of some evenly chosen points in their picture, or nearly so."""
    chosen = points_world[:: max(1, len(points_world) // probes)].astype(float)
    pixel, depth = cameras.project(rigid.apply(references.camera_from_world, chosen[None]), references.intrinsics[:, None])
    height, width = references.depth.shape[1:]
    inside = (depth > 0.1) & (np.abs(pixel[..., 0] / width - 0.5) < 0.6) & (np.abs(pixel[..., 1] / height - 0.5) < 0.6)
    return inside.any(1)


def _nearest(depth: Float[np.ndarray, "height width"], focal_px: float, options: FreeSpace) -> Float[np.ndarray, "height width"]:
    """Smallest known depth in a window as wide as the tolerated drift at the median distance; 0 where the centre is unknown."""
    known = depth > 0
    distance = float(np.median(depth[known])) if known.any() else 1.0
    radius = int(np.clip(round(focal_px * options.drift_m / distance), 1, 4))
    lowest = cv2.erode(np.where(known, depth, np.inf).astype(np.float32), np.ones((2 * radius + 1, 2 * radius + 1), np.uint8))
    return np.where(known, lowest, 0).astype(np.float32)


@numba.njit(cache=True, fastmath=True)
def _vote(points, voters, camera_from_world, pinhole, depth, nearest, color, margin_m, margin_share):
    count, (height, width) = len(points), depth.shape[1:]
    free, occupied, gap = np.zeros(count, np.int32), np.zeros(count, np.int32), np.zeros(count, np.float32)
    mean = np.zeros((count, 3), np.float32)
    for r in voters:
        m, k = camera_from_world[r], pinhole[r]
        for i in range(count):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            depth_here = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            if depth_here < 0.1:
                continue
            u = int(np.floor((m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth_here * k[0] + k[2]))
            v = int(np.floor((m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth_here * k[1] + k[3]))
            if u < 0 or v < 0 or u >= width or v >= height or depth[r, v, u] == 0:
                continue
            margin = margin_m + margin_share * depth_here
            difference = depth[r, v, u] - depth_here
            if nearest[r, v, u] - depth_here > margin:
                free[i] += 1
            elif abs(difference) < margin:
                occupied[i] += 1
                gap[i] += difference
                for channel in range(3):
                    mean[i, channel] += color[r, v, u, channel]
    for i in range(count):
        if occupied[i] > 0:
            gap[i] /= occupied[i]
            for channel in range(3):
                mean[i, channel] /= occupied[i]
    return free, occupied, gap, mean
