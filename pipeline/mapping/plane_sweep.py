"""Multi-view stereo: plane-sweep depth with semi-global matching and a geometric consistency check.

Lengths are in units of the poses. `source_views` picks the pictures to match each one with, `sweep` estimates
a depth map, `agreement` counts the other views that confirm it; `depths` does both for all views.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numba import njit

from pipeline.core.progress import track
from pipeline.geometry import cameras, rigid
from pipeline.mapping.colmap import SparseModel

PATHS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))
TRIANGULATION_DEG = (2.0, 25.0)
"""range of good triangulation angles between source and reference view, degrees"""
MIN_SHARED = 8
"""least shared points of a source view"""
DEPTH_QUANTILES, DEPTH_MARGINS = (0.01, 0.99), (0.6, 1.6)
"""quantiles of the visible points' depths that bound the sweep, and factors that widen the bounds"""
WINDOW_PX = (7, 7)
"""window of the correlation"""
CONTRAST_FLOOR = 3.0
"""contrast, in gray levels of 255, below which correlation is damped"""
P1, P2 = np.float32(0.04), np.float32(0.5)
"""semi-global matching penalties of one-plane and larger disparity steps, in units of correlation"""
EDGE_GRAY = 12
"""gray difference that halves P2"""
MAX_RELATIVE_ERROR = 0.03
"""relative depth difference within which another view agrees"""


@dataclass(frozen=True)
class SweepView:
    """One posed picture, resized to its depth map."""

    gray: Float[np.ndarray, "height width"]
    """0..255"""
    intrinsics: Float[np.ndarray, "3 3"]
    world_from_camera: Float[np.ndarray, "4 4"]

    @classmethod
    def resized(
        cls,
        gray: UInt8[np.ndarray, "_ _"],
        intrinsics: Float[np.ndarray, "3 3"],
        world_from_camera: Float[np.ndarray, "4 4"],
        side_px: int,
    ) -> "SweepView":
        """Return the view of a picture resized to a longer side of ``side_px``; intrinsics of the picture."""
        share = side_px / max(gray.shape)
        size = round(gray.shape[0] * share), round(gray.shape[1] * share)
        small = cv2.resize(gray, size[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
        return cls(small, cameras.scale_intrinsics(intrinsics, gray.shape, size), world_from_camera)


def source_views(sparse: SparseModel, max_views: int) -> list[Int[np.ndarray, "source"]]:
    """Pick source views per keyframe, best first, by shared points weighted by triangulation angle."""
    count = len(sparse.frame)
    seen = np.zeros((count, len(sparse.points_model)), bool)
    seen[sparse.observed_key, sparse.observed_point] = True
    centers = sparse.model_from_camera[:, :3, 3]
    low, high = TRIANGULATION_DEG
    chosen = []
    for key in range(count):
        shared = seen & seen[key]
        score = np.zeros(count)
        for other in np.flatnonzero(shared.sum(1) >= MIN_SHARED):
            if other != key:
                points = sparse.points_model[shared[other]]
                rays, theirs = centers[key] - points, centers[other] - points
                length = np.linalg.norm(rays, axis=1) * np.linalg.norm(theirs, axis=1)
                cosine = (rays * theirs).sum(1) / np.maximum(length, 1e-12)
                angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
                score[other] = np.clip(np.minimum(angle / low, high / np.maximum(angle, 1e-6)), 0, 1).sum()
        order = np.argsort(-score, kind="stable")
        chosen.append(order[score[order] > 0][:max_views])
    return chosen


def depth_range(sparse: SparseModel, key: int) -> tuple[float, float]:
    """Return the (near, far) bounds of a keyframe's depth: those of its points, widened."""
    points = sparse.points_model[sparse.observed_point[sparse.observed_key == key]]
    z = rigid.apply(rigid.inverse(sparse.model_from_camera[key]), points)[:, 2]
    near, far = np.quantile(z[z > 0], DEPTH_QUANTILES)
    return DEPTH_MARGINS[0] * float(near), DEPTH_MARGINS[1] * float(far)


def depths(
    views: Sequence[SweepView],
    others: Sequence[Sequence[int] | Int[np.ndarray, "source"]],
    bounds: Sequence[tuple[float, float]],
    planes: int,
) -> list[tuple[Float[np.ndarray, "height width"], UInt8[np.ndarray, "height width"]]]:
    """Return the depth of every view (0 = unknown) and its `agreement` with the views numbered by others."""
    swept, found = [], []
    for view, sources, reach in zip(track(views, "plane sweep"), others, bounds, strict=True):
        near = [views[other] for other in sources]
        swept.append(sweep(view, near, reach, planes) if near else np.zeros_like(view.gray))
    for depth, view, sources in zip(swept, views, others, strict=True):
        near = [(swept[other], views[other]) for other in sources]
        found.append((depth, agreement(depth, view, near)))
    return found


def sweep(
    view: SweepView, others: list[SweepView], depth_bounds: tuple[float, float], planes: int
) -> Float[np.ndarray, "height width"]:
    """Return the plane-sweep depth map, regularized by semi-global matching; 0 where out of range."""
    distances = 1 / np.linspace(1 / depth_bounds[1], 1 / depth_bounds[0], planes)
    correlation = np.stack([_correlation_volume(view, other, distances) for other in others])
    cost = _aggregate_views(correlation)
    total = np.zeros_like(cost)
    for d_row, d_column in PATHS:
        _aggregate_path(cost, total, d_row, d_column, P1, P2, view.gray)
    return _subplane_depth(total, distances)


def _correlation_volume(
    view: SweepView, other: SweepView, distances: np.ndarray
) -> Float[np.ndarray, "plane height width"]:
    """Return normalized cross-correlation per plane; -1 outside the other view."""

    def mean(picture):
        return cv2.boxFilter(picture, cv2.CV_32F, WINDOW_PX)

    relative = rigid.inverse(other.world_from_camera) @ view.world_from_camera
    pixel_to_index = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    to_pixel, from_pixel = pixel_to_index @ other.intrinsics, np.linalg.inv(pixel_to_index @ view.intrinsics)
    own_mean = mean(view.gray)
    own_variance = np.maximum(mean(view.gray**2) - own_mean**2, 0)
    inside, size = np.full(other.gray.shape, 255, np.uint8), view.gray.shape[::-1]
    correlation = np.empty((len(distances), *view.gray.shape), np.float32)
    linear, nearest = (how | cv2.WARP_INVERSE_MAP for how in (cv2.INTER_LINEAR, cv2.INTER_NEAREST))
    for plane, distance in enumerate(distances):
        plane_motion = relative[:3, :3].copy()
        plane_motion[:, 2] += relative[:3, 3] / distance
        homography = to_pixel @ plane_motion @ from_pixel
        warped = cv2.warpPerspective(
            other.gray, homography, size, flags=linear, borderMode=cv2.BORDER_REPLICATE
        )
        known = cv2.warpPerspective(inside, homography, size, flags=nearest) > 0
        other_mean = mean(warped)
        variance = np.maximum(mean(warped**2) - other_mean**2, 0)
        covariance = mean(warped * view.gray) - other_mean * own_mean
        ratio = covariance / (np.sqrt(own_variance * variance) + CONTRAST_FLOOR**2)
        correlation[plane] = np.where(known, ratio, -1)
    return correlation


@njit(cache=True, nogil=True)
def _aggregate_views(correlation):
    """Average 1 - correlation over the better half of the views that see a pixel; 1 where none does."""
    sources, planes, height, width = correlation.shape
    cost = np.ones((planes, height, width), np.float32)
    best = np.empty(sources, np.float32)
    for plane in range(planes):
        for row in range(height):
            for column in range(width):
                count = 0
                for source in range(sources):
                    value = correlation[source, plane, row, column]
                    if value > -1:
                        place = count
                        while place > 0 and best[place - 1] < value:
                            best[place] = best[place - 1]
                            place -= 1
                        best[place] = value
                        count += 1
                half = (count + 1) // 2
                if half:
                    total = np.float32(0)
                    for source in range(half):
                        total += 1 - best[source]
                    cost[plane, row, column] = total / half
    return cost


@njit(cache=True, nogil=True)
def _aggregate_path(cost, total, d_row, d_column, p1, p2, gray):
    """Add one path of semi-global matching (Hirschmueller 2008); P2 is lower across image edges."""
    planes, height, width = cost.shape
    path = np.zeros((height, width, planes), np.float32)
    for step_row in range(height):
        row = step_row if d_row >= 0 else height - 1 - step_row
        for step_column in range(width):
            column = step_column if d_column >= 0 else width - 1 - step_column
            before_row, before_column = row - d_row, column - d_column
            if before_row < 0 or before_column < 0 or before_row >= height or before_column >= width:
                for plane in range(planes):
                    path[row, column, plane] = cost[plane, row, column]
            else:
                prev = path[before_row, before_column]
                least, edge = prev.min(), abs(gray[row, column] - gray[before_row, before_column])
                jump = least + p2 / (1 + edge / EDGE_GRAY)
                for plane in range(planes):
                    value = min(prev[plane], jump)
                    if plane > 0:
                        value = min(value, prev[plane - 1] + p1)
                    if plane + 1 < planes:
                        value = min(value, prev[plane + 1] + p1)
                    path[row, column, plane] = cost[plane, row, column] + value - least
            for plane in range(planes):
                total[plane, row, column] += path[row, column, plane]


def _subplane_depth(
    total: Float[np.ndarray, "plane height width"], distances: np.ndarray
) -> Float[np.ndarray, "height width"]:
    """Return the depth of least cost with parabolic sub-plane refinement; 0 at the ends of the range."""
    best = total.argmin(0)
    inner = np.clip(best, 1, len(distances) - 2)
    prev, at, after = (np.take_along_axis(total, (inner + shift)[None], 0)[0] for shift in (-1, 0, 1))
    curve = prev - 2 * at + after
    shift = np.where(curve > 1e-6, np.clip(0.5 * (prev - after) / np.maximum(curve, 1e-6), -0.5, 0.5), 0)
    inverse = 1 / distances[0] + (inner + shift) * (1 / distances[1] - 1 / distances[0])
    return np.where(best == inner, 1 / inverse, 0).astype(np.float32)


def agreement(
    depth: Float[np.ndarray, "height width"],
    view: SweepView,
    others: list[tuple[Float[np.ndarray, "height width"], SweepView]],
) -> UInt8[np.ndarray, "height width"]:
    """Count, per pixel, the other views whose depth agrees."""
    points_camera = cameras.back_project(depth, view.intrinsics).reshape(-1, 3)
    points_world = rigid.apply(view.world_from_camera, points_camera)
    count = np.zeros(depth.size, np.uint8)
    for other_depth, other in others:
        points_other = rigid.apply(rigid.inverse(other.world_from_camera), points_world)
        measured = cameras.lookup_depth(other_depth, other.intrinsics, points_other)
        off = np.abs(measured - points_other[:, 2])
        count += (measured > 0) & (off < MAX_RELATIVE_ERROR * points_other[:, 2])
    return np.where(depth > 0, count.reshape(depth.shape), np.uint8(0))
