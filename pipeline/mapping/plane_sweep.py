"""Depth from posed pictures: a plane sweep, smoothed along eight paths, kept where other pictures agree.

Everything is in the units of the poses. `neighbours` picks the pictures that each one is compared with,
`sweep` makes one picture's depth, `agreement` counts how many others confirm it.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numba import njit

from pipeline.geometry import cameras, rigid
from pipeline.mapping.colmap import SparseModel

PATHS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))
BASELINE_DEG = (2.0, 25.0)
"""angles between rays to a shared point that pictures are chosen for, degrees"""
MIN_SHARED = 8
"""points that two pictures must share to be compared"""
DEPTH_QUANTILES, DEPTH_MARGINS = (0.01, 0.99), (0.6, 1.6)
"""the sweep reaches from the nearest to the farthest point in view, and so much beyond"""
WINDOW_PX = (7, 7)
"""size of the compared patches"""
CONTRAST_FLOOR = 3.0
"""grey levels (of 255) of contrast below which a patch carries little information"""
SMALL_STEP, LARGE_STEP = np.float32(0.04), np.float32(0.5)
"""P1 and P2 of semi-global matching, in correlation: steps of one plane between pixels, and larger ones"""
EDGE_GRAY = 12
"""difference of grey values at which a jump of depth costs half as much"""
AGREE_SHARE = 0.03
"""relative difference of depth within which another picture agrees"""


@dataclass(frozen=True)
class SweepView:
    """One posed picture, at the size of its depth."""

    gray: Float[np.ndarray, "height width"]
    """0..255"""
    intrinsics: Float[np.ndarray, "3 3"]
    world_from_camera: Float[np.ndarray, "4 4"]


def neighbours(sparse: SparseModel, most: int) -> list[Int[np.ndarray, "source"]]:
    """Pick for each key at most so many others that share the most points under a good angle, best first."""
    count = len(sparse.frame)
    seen = np.zeros((count, len(sparse.points_model)), bool)
    seen[sparse.observed_key, sparse.observed_point] = True
    centres = sparse.model_from_camera[:, :3, 3]
    low, high = BASELINE_DEG
    chosen = []
    for key in range(count):
        shared = seen & seen[key]
        score = np.zeros(count)
        for other in np.flatnonzero(shared.sum(1) >= MIN_SHARED):
            if other != key:
                points = sparse.points_model[shared[other]]
                rays, theirs = centres[key] - points, centres[other] - points
                length = np.linalg.norm(rays, axis=1) * np.linalg.norm(theirs, axis=1)
                cosine = (rays * theirs).sum(1) / np.maximum(length, 1e-12)
                angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
                score[other] = np.clip(np.minimum(angle / low, high / np.maximum(angle, 1e-6)), 0, 1).sum()
        order = np.argsort(-score, kind="stable")
        chosen.append(order[score[order] > 0][:most])
    return chosen


def depth_range(sparse: SparseModel, key: int) -> tuple[float, float]:
    """Return the (nearest, furthest) distance worth trying for a key: that of its points, and some more."""
    points = sparse.points_model[sparse.observed_point[sparse.observed_key == key]]
    z = rigid.apply(rigid.inverse(sparse.model_from_camera[key]), points)[:, 2]
    near, far = np.quantile(z[z > 0], DEPTH_QUANTILES)
    return DEPTH_MARGINS[0] * float(near), DEPTH_MARGINS[1] * float(far)


def sweep(
    view: SweepView, others: list[SweepView], reach: tuple[float, float], planes: int
) -> Float[np.ndarray, "height width"]:
    """Return the depth at which patches of a picture correlate best with the others, smooth but for edges."""
    distances = 1 / np.linspace(1 / reach[1], 1 / reach[0], planes)
    correlation = np.stack([_correlation(view, other, distances) for other in others])
    cost = _combined(correlation)
    total = np.zeros_like(cost)
    for down, right in PATHS:
        _add_path(cost, total, down, right, SMALL_STEP, LARGE_STEP, view.gray)
    return _between(total, distances)


def _correlation(
    view: SweepView, other: SweepView, distances: np.ndarray
) -> Float[np.ndarray, "plane height width"]:
    """Return the normalised correlation of patches, plane by plane; -1 where the other does not reach."""

    def mean(picture):
        return cv2.boxFilter(picture, cv2.CV_32F, WINDOW_PX)

    relative = rigid.inverse(other.world_from_camera) @ view.world_from_camera
    centred = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    to_pixel, from_pixel = centred @ other.intrinsics, np.linalg.inv(centred @ view.intrinsics)
    own_mean = mean(view.gray)
    own_variance = np.maximum(mean(view.gray**2) - own_mean**2, 0)
    inside, size = np.full(other.gray.shape, 255, np.uint8), view.gray.shape[::-1]
    correlation = np.empty((len(distances), *view.gray.shape), np.float32)
    linear, nearest = (how | cv2.WARP_INVERSE_MAP for how in (cv2.INTER_LINEAR, cv2.INTER_NEAREST))
    for plane, distance in enumerate(distances):
        through = relative[:3, :3].copy()
        through[:, 2] += relative[:3, 3] / distance
        homography = to_pixel @ through @ from_pixel
        warped = cv2.warpPerspective(
            other.gray, homography, size, flags=linear, borderMode=cv2.BORDER_REPLICATE
        )
        known = cv2.warpPerspective(inside, homography, size, flags=nearest) > 0
        their_mean = mean(warped)
        variance = np.maximum(mean(warped**2) - their_mean**2, 0)
        together = mean(warped * view.gray) - their_mean * own_mean
        ratio = together / (np.sqrt(own_variance * variance) + CONTRAST_FLOOR**2)
        correlation[plane] = np.where(known, ratio, -1)
    return correlation


@njit(cache=True, nogil=True)
def _combined(correlation):
    """Average 1 - correlation over the better half of the pictures that reach a pixel; 1 where none does."""
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
def _add_path(cost, total, down, right, small, large, gray):
    """Add one direction of semi-global matching (Hirschmueller 2008); large steps cost less across edges."""
    planes, height, width = cost.shape
    path = np.zeros((height, width, planes), np.float32)
    for step_row in range(height):
        row = step_row if down >= 0 else height - 1 - step_row
        for step_column in range(width):
            column = step_column if right >= 0 else width - 1 - step_column
            before_row, before_column = row - down, column - right
            if before_row < 0 or before_column < 0 or before_row >= height or before_column >= width:
                for plane in range(planes):
                    path[row, column, plane] = cost[plane, row, column]
            else:
                before = path[before_row, before_column]
                least, edge = before.min(), abs(gray[row, column] - gray[before_row, before_column])
                jump = least + large / (1 + edge / EDGE_GRAY)
                for plane in range(planes):
                    value = min(before[plane], jump)
                    if plane > 0:
                        value = min(value, before[plane - 1] + small)
                    if plane + 1 < planes:
                        value = min(value, before[plane + 1] + small)
                    path[row, column, plane] = cost[plane, row, column] + value - least
            for plane in range(planes):
                total[plane, row, column] += path[row, column, plane]


def _between(
    total: Float[np.ndarray, "plane height width"], distances: np.ndarray
) -> Float[np.ndarray, "height width"]:
    """Return the distance of least cost, between planes by a parabola; 0 at the ends of the range."""
    best = total.argmin(0)
    inner = np.clip(best, 1, len(distances) - 2)
    before, at, after = (np.take_along_axis(total, (inner + shift)[None], 0)[0] for shift in (-1, 0, 1))
    bend = before - 2 * at + after
    shift = np.where(bend > 1e-6, np.clip(0.5 * (before - after) / np.maximum(bend, 1e-6), -0.5, 0.5), 0)
    inverse = 1 / distances[0] + (inner + shift) * (1 / distances[1] - 1 / distances[0])
    return np.where(best == inner, 1 / inverse, 0).astype(np.float32)


def agreement(
    depth: Float[np.ndarray, "height width"],
    view: SweepView,
    others: list[tuple[Float[np.ndarray, "height width"], SweepView]],
) -> UInt8[np.ndarray, "height width"]:
    """Count, per pixel, the other pictures that agree with the depth."""
    points_camera = cameras.back_project(depth, view.intrinsics).reshape(-1, 3)
    points_world = rigid.apply(view.world_from_camera, points_camera)
    count = np.zeros(depth.size, np.uint8)
    for theirs, other in others:
        theirs_camera = rigid.apply(rigid.inverse(other.world_from_camera), points_world)
        pixel, z = cameras.project(theirs_camera, other.intrinsics)
        inside = np.flatnonzero((depth.ravel() > 0) & cameras.in_picture(pixel, z, theirs.shape))
        column, row = np.floor(pixel[inside]).astype(int).T
        met = theirs[row, column]
        count[inside] += (met > 0) & (np.abs(met - z[inside]) < AGREE_SHARE * z[inside])
    return count.reshape(depth.shape)
