"""Color and features of the surface, averaged over the frames that see a vertex."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Num, UInt8
from scipy.spatial import KDTree

from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import Mesh, RayCaster, render_view

SEEN_WEIGHT = 0.05
"""total view weight above which a vertex counts as seen"""
BORDER_CELLS = 1.001
"""positions are clamped this many cells inside the border, for bilinear interpolation"""
NEAREST_M = 0.1
"""vertices nearer to the camera are ignored"""


def visibility(
    mesh_agent: Mesh,
    agent_from_camera: Float[np.ndarray, "view 4 4"],
    intrinsics: Float[np.ndarray, "view 3 3"],
    size: tuple[int, int],
    tolerance_m: float = 0.01,
) -> tuple[Float[np.ndarray, "view vertex"], Float[np.ndarray, "view vertex 2"]]:
    """Return view weights of vertices (squared cosine to the normal; 0: occluded) and their color pixels.

    ``size`` is (height, width) of the color pictures; those behind the mesh by the tolerance are occluded.
    """
    caster = RayCaster(mesh_agent)
    normals = mesh_agent.vertex_normals()
    vertices = mesh_agent.vertices.astype(float)
    coarse = (size[0] // 2, size[1] // 2)
    weights, pixels = [], []
    for pose, k in zip(agent_from_camera, intrinsics, strict=True):
        rendered, _ = render_view(caster, pose, cameras.scale_intrinsics(k, size, coarse), *coarse)
        pixel, depth = cameras.project(rigid.apply(rigid.inverse(pose), vertices), k)
        at = pixel * [coarse[1] / size[1], coarse[0] / size[0]]
        seen = (depth > NEAREST_M) & (np.abs(cameras.sample_nearest(rendered, at) - depth) < tolerance_m)
        toward = pose[:3, 3] - vertices
        facing = (normals * toward).sum(1) / np.linalg.norm(toward, axis=1)
        weights.append(np.where(seen, np.clip(facing, 0, 1) ** 2, 0))
        pixels.append(pixel)
    return np.stack(weights), np.stack(pixels)


def on_mask(
    pixel: Float[np.ndarray, "vertex 2"], labels: UInt8[np.ndarray, "height width"]
) -> Bool[np.ndarray, "vertex"]:
    """Return which vertices project onto the mask (255); a moved limb shows the background instead."""
    return cameras.sample_nearest(labels, pixel) == 255


def average_views(
    vertices: Float[np.ndarray, "vertex 3"],
    weight: Float[np.ndarray, "view vertex"],
    pixel: Float[np.ndarray, "view vertex 2"],
    pictures: Sequence[Num[np.ndarray, "height width channel"]],
    stride_px: int,
) -> Float[np.ndarray, "vertex channel"]:
    """Average pictures (cells of ``stride_px`` color pixels) over views; unseen vertices copy neighbors."""
    total = sum(
        w[:, None] * _bilinear(picture, at / stride_px)
        for w, at, picture in zip(weight, pixel, pictures, strict=True)
    )
    seen = weight.sum(0) > SEEN_WEIGHT
    mean = total / np.maximum(weight.sum(0), 1e-9)[:, None]
    if seen.any() and not seen.all():
        mean[~seen] = mean[seen][KDTree(vertices[seen]).query(vertices[~seen])[1]]
    return mean


def _bilinear(
    picture: Num[np.ndarray, "height width channel"], position: Float[np.ndarray, "point 2"]
) -> Float[np.ndarray, "point channel"]:
    """Interpolate bilinearly at positions in cells, whose centers lie at half-integers."""
    height, width = picture.shape[:2]
    grid = np.clip(position - 0.5, 0, [width - BORDER_CELLS, height - BORDER_CELLS])
    low = np.floor(grid).astype(int)
    part = grid - low
    picture, (x, y) = picture.astype(np.float32), low.T
    right, down = part[:, :1], part[:, 1:]
    upper, lower = ((1 - right) * picture[row, x] + right * picture[row, x + 1] for row in (y, y + 1))
    return (1 - down) * upper + down * lower
