"""Free space: a point that other frames saw through is not part of the static room.

`References` keeps a fixed number of depth pictures spread over the recording, before and after any frame, so
that a resting animal is recognized by the times when its place was empty. Voting costs O(references) a frame.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numba
import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.data.clips import Clip, usable_depth
from pipeline.geometry import cameras, rigid, subsampling
from pipeline.mapping import odometry
from pipeline.mapping.icp import align_views, depth_image

MARGIN_M = 0.03
"""a surface this far plus four standard deviations of depth noise behind a point proves free space"""
LATERAL_ERROR_M = 0.015
"""tolerated pose error across the line of sight"""
VIEW_MARGIN, VIEW_PROBES, NOISE_PROBES = 0.6, 96, 800
"""a reference votes if a probe projects within this share of the picture from its middle; number of probes;
number of pixels per picture from which noise is measured"""
SIGMAS = 4.0
"""standard deviations of depth noise that are significant"""
NEAREST_M = 0.1
"""minimum depth of a projected point"""
STEPS = np.linspace(-1, 1, 9)
SHIFTS = np.array([(x, y, 0) for x in STEPS for y in STEPS if x**2 + y**2 <= 1])
"""shares of the drift, across the line of sight, at which a thing is sought"""
MIN_WITNESSES, MIN_THROUGH = 3, 0.3
"""references that must have seen through a thing wherever drift may put it, and through this share of it"""
MAX_NOISE_M = 0.15
"""larger depth differences are other surfaces, not noise"""
DRIFT_M, DRIFT_QUANTILE, DRIFT_PX = 0.08, 0.9, 100
"""drift of a Kinect's odometry within 17 s, assumed where none is measured; quantile of the pairs of pictures
that are measured, and pixels along their longer side"""
DRIFT_GAPS, MIN_FACING, MIN_DRIFTS = (8, 4, 2), 0.6, 10
"""shares of a recording between both pictures, cosine of the angle between their axes, and least pairs"""
MIN_PAIRS, MAD_TO_SIGMA, MIN_NOISE_M = 200, 1.48, 0.002
"""differences required per range bin, MAD to sigma, and the least deviation of any sensor"""
BLUR_PX = 1.2
"""standard deviation of the blur before colors are compared, so that small pose errors are tolerated"""
INNER_WIDTH_PX = 320
"""picture width per pixel of window radius for `interior_depth`; narrower pictures are phones', whose
confidence marks steps"""
INNER_STEP_SHARE = 0.12
"""depth range within that window, as a share of the depth, that is a step between surfaces"""


@dataclass(frozen=True)
class DepthNoise:
    """Depth noise of one recording, sensor and poses together.

    Standard deviation in meters = constant_m + quadratic * z^2, z in meters, as for triangulation.
    """

    constant_m: float = 0.005
    quadratic: float = 0.0025

    def sigma_m(self, z: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """Return the standard deviation at a distance, meters."""
        return self.constant_m + self.quadratic * z**2


@dataclass(frozen=True)
class References:
    """Depth pictures that vote; ``nearest``, the local minimum of depth, tolerates drift at edges."""

    camera_from_world: Float[np.ndarray, "reference 4 4"]
    intrinsics: Float[np.ndarray, "reference 3 3"]
    depth: Float[np.ndarray, "reference height width"]
    nearest: Float[np.ndarray, "reference height width"]
    color: UInt8[np.ndarray, "reference height width 3"]
    frame: Int[np.ndarray, "reference"]
    noise: DepthNoise
    drift_m: float = DRIFT_M
    """pose error across the line of sight"""
    ignored: Callable[[int, Float[np.ndarray, "*shape 3"]], Bool[np.ndarray, "*shape"]] | None = None
    """which points (world, meters) of a frame belong to people and never count as moving"""


@dataclass(frozen=True)
class Votes:
    """Per point: references that saw through it, that saw a surface there, and the mean gap to it."""

    free: Int[np.ndarray, "*shape"]
    occupied: Int[np.ndarray, "*shape"]
    gap_m: Float[np.ndarray, "*shape"]
    """mean distance from the point back to the agreeing references' surfaces"""
    color: Float[np.ndarray, "*shape 3"]
    """mean color (0..255) of those surfaces"""


def interior_depth(clip: Clip, frame: int) -> Float[np.ndarray, "height width"]:
    """Read depth away from steps, holes and low confidence (meters, 0 = unknown)."""
    depth = usable_depth(clip, frame, keep_steps=False)
    kernel = np.ones((2 * (max(depth.shape) // INNER_WIDTH_PX) + 1,) * 2, np.uint8)
    low, high = cv2.erode(depth, kernel), cv2.dilate(depth, kernel)
    return np.where((low > 0) & (high - low < INNER_STEP_SHARE * depth), depth, 0).astype(np.float32)


def world_points(
    clip: Clip,
    frame: int,
    world_from_camera: Float[np.ndarray, "4 4"],
    depth: Float[np.ndarray, "height width"],
    stride: int,
) -> Float[np.ndarray, "row column 3"]:
    """Back-project every ``stride``-th depth pixel to the world, meters; NaN where depth is 0."""
    every = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    pixel, depth = cameras.pixel_grid(*depth.shape)[every], depth[every]
    rays = cameras.unproject(pixel, clip.depth_intrinsics[frame])
    points = rigid.apply(world_from_camera, (rays * depth[..., None]).reshape(-1, 3)).reshape(*depth.shape, 3)
    points[depth == 0] = np.nan
    return points


def sample(
    clip: Clip,
    frame: int,
    world_from_camera: Float[np.ndarray, "4 4"],
    depth: Float[np.ndarray, "height width"],
    wanted_px: int,
) -> tuple[Float[np.ndarray, "row column 3"], Float[np.ndarray, "row column"], tuple[slice, slice]]:
    """Subsample depth to about ``wanted_px`` squared pixels: `world_points`, areas in m^2, slices."""
    stride = max(1, round(math.sqrt(depth.size) / wanted_px))
    chosen = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    focal_px2 = clip.depth_intrinsics[frame, 0, 0] * clip.depth_intrinsics[frame, 1, 1]
    points = world_points(clip, frame, world_from_camera, depth, stride)
    return points, (depth[chosen] * stride) ** 2 / focal_px2, chosen


def gather(clip: Clip, world_from_camera: Float[np.ndarray, "frame 4 4"], count: int) -> References:
    """Read the ``count`` depth pictures that vote."""
    frames = subsampling.evenly(len(clip), count, rounded=True)
    depth = np.stack([usable_depth(clip, frame, keep_steps=False) for frame in frames])
    size = clip.depth_size[::-1]
    small = (cv2.resize(clip.color(frame), size, interpolation=cv2.INTER_AREA) for frame in frames)
    color = np.stack([cv2.GaussianBlur(each, (5, 5), BLUR_PX) for each in small])
    camera_from_world, pinhole = rigid.inverse(world_from_camera[frames]), clip.depth_intrinsics[frames]
    noise = measure_noise(depth, camera_from_world, pinhole)
    drift_m = measure_drift(depth, camera_from_world, pinhole)
    nearest = _min_filter(depth, pinhole)
    return References(camera_from_world, pinhole, depth, nearest, color, frames, noise, drift_m)


def measure_noise(
    depth: Float[np.ndarray, "reference height width"],
    camera_from_world: Float[np.ndarray, "reference 4 4"],
    intrinsics: Float[np.ndarray, "reference 3 3"],
) -> DepthNoise:
    """Fit the depth noise to differences of each other picture from the next and from one a fifth later.

    A robust deviation (1.48 times the median) per half meter of range, then non-negative least squares. The
    default if too little overlaps.
    """
    ranges, errors = [], []
    count, later = len(depth), max(2, len(depth) // 5)
    pairs = [(a, a + gap) for a in range(0, count - 1, 2) for gap in (1, later) if a + gap < count]
    for first, second in pairs:
        inner = cv2.erode((depth[first] > 0).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        chosen = np.flatnonzero(inner)[:: max(1, int(inner.sum()) // NOISE_PROBES)]
        rows, columns = np.unravel_index(chosen, inner.shape)
        rays = cameras.unproject(cameras.pixel_centers(rows, columns), intrinsics[first])
        points = rays * depth[first][rows, columns][:, None]
        relative = camera_from_world[second] @ rigid.inverse(camera_from_world[first])
        points = rigid.apply(relative, points)
        measured, z = cameras.lookup_depth(depth[second], intrinsics[second], points, NEAREST_M), points[:, 2]
        near = (measured > 0) & (np.abs(measured - z) < MAX_NOISE_M)
        ranges.append(z[near])
        errors.append(np.abs(measured - z)[near])
    z, error = np.concatenate(ranges), np.concatenate(errors)
    bins = [(z >= low) & (z < low + 0.5) for low in np.arange(0.25, 6, 0.5)]
    bins = [own for own in bins if own.sum() > MIN_PAIRS]
    if len(bins) < 2:
        return DepthNoise()
    middle = np.array([float(np.median(z[own])) for own in bins])
    sigma = np.array([MAD_TO_SIGMA * float(np.median(error[own])) for own in bins])
    (constant, quadratic), _ = scipy.optimize.nnls(np.stack([np.ones_like(middle), middle**2], axis=1), sigma)
    return DepthNoise(max(float(constant), MIN_NOISE_M), float(quadratic))


def measure_drift(
    depth: Float[np.ndarray, "reference height width"],
    camera_from_world: Float[np.ndarray, "reference 4 4"],
    intrinsics: Float[np.ndarray, "reference 3 3"],
) -> float:
    """Return the poses' error across the line of sight, meters, by ICP; `DRIFT_M` if few pictures overlap."""
    stride, count, found = max(1, max(depth.shape[1:]) // DRIFT_PX), len(depth), []
    views = [depth_image(each, k, each > 0, stride) for each, k in zip(depth, intrinsics, strict=True)]
    steps = [(first, count // gap) for first in range(0, count, 2) for gap in DRIFT_GAPS]
    for first, second in [(first, first + step) for first, step in steps if 0 < step < count - first]:
        guess = camera_from_world[first] @ rigid.inverse(camera_from_world[second])
        if guess[2, 2] < MIN_FACING:
            continue
        how = {"reach_m": odometry.REACH_M, "iterations": odometry.ICP_ITERATIONS}
        result = align_views(views[first], views[second], guess, **how)
        if odometry.is_reliable(result):
            points = views[second].points[views[second].points[..., 2] > 0]
            before = rigid.apply(guess, subsampling.some(points, NOISE_PROBES).astype(float))
            off = before - rigid.apply(result.target_from_source @ rigid.inverse(guess), before)
            across_m = np.linalg.norm(np.cross(off, before), axis=1) / np.linalg.norm(before, axis=1)
            found.append(float(np.median(across_m)))
    enough = len(found) >= MIN_DRIFTS
    return LATERAL_ERROR_M + float(np.quantile(found, DRIFT_QUANTILE)) if enough else DRIFT_M


def masked(references: References, hidden: Callable[[int], Bool[np.ndarray, "height width"]]) -> References:
    """Remove the references' depth where ``hidden`` of a frame (at any resolution) is set."""
    depth, size = references.depth.copy(), references.depth.shape[1:][::-1]
    for picture, frame in zip(depth, references.frame, strict=True):
        forgotten = cv2.resize(hidden(int(frame)).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        picture[forgotten > 0] = 0
    return replace(references, depth=depth, nearest=_min_filter(depth, references.intrinsics))


def vote(
    references: References, points_world: Float[np.ndarray, "*shape 3"], frame: int, surfaces: bool = False
) -> Votes:
    """Let the other references vote on points (world, meters; NaN: none); colors only with ``surfaces``."""
    known = np.isfinite(points_world[..., 0])
    points = np.ascontiguousarray(points_world[known], np.float32)
    other = np.flatnonzero((references.frame != frame) & _in_view(references, points))
    pinhole = references.intrinsics[:, [0, 1, 0, 1], [0, 1, 2, 2]].astype(np.float32)
    poses, noise = references.camera_from_world.astype(np.float32), references.noise
    margin = (np.float32(MARGIN_M + SIGMAS * noise.constant_m), np.float32(SIGMAS * noise.quadratic))
    pictures = references.depth, references.nearest, references.color
    results = _vote(points, other, poses, pinhole, *pictures, *margin, surfaces)
    votes = [np.zeros(known.shape + values.shape[1:], values.dtype) for values in results]
    for whole, values in zip(votes, results, strict=True):
        whole[known] = values
    if references.ignored is not None:
        votes[0][references.ignored(frame, points_world)] = 0
    return Votes(*votes)


def seen_through(references: References, points_world: Float[np.ndarray, "point 3"], frame: int) -> bool:
    """Return whether other references saw through a thing even where drift may have put it.

    Poses drift, so that votes see past things that stay. A reference is a witness if no shift of the points
    (world, meters) across its line of sight, up to the drift, makes them a surface or hidden.
    """
    points, witnesses = points_world[:: max(1, len(points_world) // VIEW_PROBES)], 0
    for reference in np.flatnonzero((references.frame != frame) & _in_view(references, points)):
        pose, pinhole = references.camera_from_world[reference], references.intrinsics[reference]
        shifted = rigid.apply(pose, points) + references.drift_m * SHIFTS[:, None]
        z = shifted[..., 2]
        measured = cameras.lookup_depth(references.depth[reference], pinhole, shifted, NEAREST_M)
        known = (measured > 0).sum(1)
        through = (measured - z > MARGIN_M + SIGMAS * references.noise.sigma_m(z)).sum(1)
        placed, past = known > len(points) / 2, through > MIN_THROUGH * known
        witnesses += bool(placed[len(SHIFTS) // 2] and past[placed].all())
        if witnesses == MIN_WITNESSES:
            return True
    return False


def _in_view(
    references: References, points_world: Float[np.ndarray, "point 3"]
) -> Bool[np.ndarray, "reference"]:
    """Return which references have some of the points in view, or nearly so."""
    chosen = points_world[:: max(1, len(points_world) // VIEW_PROBES)].astype(float)
    points_camera = rigid.apply(references.camera_from_world, chosen[None])
    pixel, depth = cameras.project(points_camera, references.intrinsics[:, None])
    share = pixel / references.depth.shape[:0:-1]
    near = (np.abs(share - 0.5) < VIEW_MARGIN).all(-1)
    return np.any((depth > NEAREST_M) & near, axis=1)


def _min_filter(
    depth: Float[np.ndarray, "reference height width"], intrinsics: Float[np.ndarray, "reference 3 3"]
) -> Float[np.ndarray, "reference height width"]:
    """Return the local minimum of depth in a window as wide as the tolerated drift; 0 beside holes.

    Sensors miss thin and glossy things, so depth beside a hole does not prove free space.
    """
    nearest = []
    for picture, focal_px in zip(depth, intrinsics[:, 0, 0], strict=True):
        known = picture > 0
        distance = float(np.median(picture[known])) if known.any() else 1.0
        radius = int(np.clip(round(focal_px * LATERAL_ERROR_M / distance), 1, 4))
        window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
        lowest = cv2.erode(np.where(known, picture, np.inf).astype(np.float32), window)
        whole = cv2.erode(known.astype(np.uint8), window) > 0
        nearest.append(np.where(whole, lowest, 0).astype(np.float32))
    return np.stack(nearest)


@numba.njit(cache=True, fastmath=True)
def _vote(points, voters, camera_from_world, pinhole, depth, nearest, color, margin_m, quadratic, surfaces):
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
            margin = margin_m + quadratic * depth_here * depth_here
            difference = depth[r, v, u] - depth_here
            if nearest[r, v, u] - depth_here > margin:
                free[i] += 1
            elif abs(difference) < margin:
                occupied[i] += 1
                gap[i] += difference
                for channel in range(3 * surfaces):
                    mean[i, channel] += color[r, v, u, channel]
    for i in range(count):
        if occupied[i] > 0:
            gap[i] /= occupied[i]
            for channel in range(3):
                mean[i, channel] /= occupied[i]
    return free, occupied, gap, mean
