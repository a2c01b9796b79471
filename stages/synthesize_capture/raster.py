"""Rasterize triangles for a pinhole camera, without clipping.

For a triangle with corners M = [v0 v1 v2] in camera axes, the barycentric coordinates of the ray d = (x, y,
1) divided by its depth are M^-1 d, and their sum is 1 / depth (Olano and Greer 1997). Each is linear along a
row of pixels, so a row's span follows from three inequalities; triangles that pass behind the camera need no
clipping.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numba import njit

NEAR_M = 0.03


@dataclass(frozen=True)
class RasterView:
    """Rasterized view: nearest face per sample (-1: none), 1 / depth, and M^-1 per face."""

    face: Int[np.ndarray, "height width"]
    inverse_depth: Float[np.ndarray, "height width"]
    inverse_corners: Float[np.ndarray, "face 3 3"]


def rasterize(
    points_camera: Float[np.ndarray, "vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    intrinsics: Float[np.ndarray, "3 3"],
    height: int,
    width: int,
) -> RasterView:
    """Find the nearest face at each pixel center, without back-face culling."""
    face = np.full((height, width), -1, np.int32)
    inverse_depth = np.zeros((height, width), np.float32)
    inverse_corners = np.zeros((len(faces), 3, 3), np.float64)
    focal_center = np.array([intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]])
    points = np.ascontiguousarray(points_camera, np.float64)
    _scan(points, faces, focal_center, inverse_corners, face, inverse_depth)
    return RasterView(face, inverse_depth, inverse_corners)


@njit(cache=True, error_model="numpy")
def _scan(points, faces, focal_center, inverse_corners, face_of, inverse_depth):
    height, width = face_of.shape
    fx, fy, cx, cy = focal_center
    row = np.empty(3)
    for f in range(faces.shape[0]):
        a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
        nearest = min(a[2], b[2], c[2])
        if max(a[2], b[2], c[2]) <= NEAR_M or not _invert(a, b, c, inverse_corners[f]):
            continue
        top, bottom = 0, height
        if nearest > NEAR_M:
            ya, yb, yc = a[1] / a[2] * fy + cy, b[1] / b[2] * fy + cy, c[1] / c[2] * fy + cy
            low, high = min(ya, yb, yc), max(ya, yb, yc)
            if high < 0 or low > height:
                continue
            top, bottom = max(0, int(np.floor(low - 0.5))), min(height, int(np.ceil(high + 0.5)))
        inverse = inverse_corners[f]
        slope = (inverse[0, 0] + inverse[1, 0] + inverse[2, 0]) / fx
        for i in range(top, bottom):
            y = (i + 0.5 - cy) / fy
            first, last = 0, width - 1
            total = 0.0
            for k in range(3):
                gradient = inverse[k, 0] / fx
                row[k] = inverse[k, 0] * (0.5 - cx) / fx + inverse[k, 1] * y + inverse[k, 2]
                total += row[k]
                if gradient > 0:
                    first = max(first, int(np.ceil(min(-row[k] / gradient, 1e6))))
                elif gradient < 0:
                    last = min(last, int(np.floor(max(min(-row[k] / gradient, 1e6), -1e6))))
                elif row[k] < 0:
                    last = -1
            for j in range(first, last + 1):
                inverse_z = total + slope * j
                if inverse_z > inverse_depth[i, j] and inverse_z < 1.0 / NEAR_M:
                    inverse_depth[i, j] = inverse_z
                    face_of[i, j] = f


@njit(cache=True, error_model="numpy", inline="always")
def _invert(a, b, c, out):
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        out[0, k] = b[m] * c[n] - b[n] * c[m]
        out[1, k] = c[m] * a[n] - c[n] * a[m]
        out[2, k] = a[m] * b[n] - a[n] * b[m]
    volume = a[0] * out[0, 0] + a[1] * out[0, 1] + a[2] * out[0, 2]
    if abs(volume) < 1e-14:
        return False
    for i in range(3):
        for k in range(3):
            out[i, k] /= volume
    return True


@njit(cache=True, error_model="numpy")
def depth_through(face_of, inverse_depth, inverse_corners, focal_center, height, width):
    """Return exact z-depth ``[height width]`` (0 = nothing) at the view's pixel centers in another size."""
    depth = np.zeros((height, width), np.float32)
    fx, fy, cx, cy = focal_center
    rows, columns = face_of.shape
    for i in range(height):
        for j in range(width):
            row, column = int((i + 0.5) / height * rows), int((j + 0.5) / width * columns)
            face = face_of[row, column]
            if face >= 0:
                x, y = (j + 0.5 - cx) / fx, (i + 0.5 - cy) / fy
                total, inverse = 0.0, inverse_corners[face]
                for k in range(3):
                    total += inverse[k, 0] * x + inverse[k, 1] * y + inverse[k, 2]
                near = inverse_depth[row, column]
                depth[i, j] = 1.0 / min(max(total, 0.97 * near), 1.03 * near)
    return depth
