"""Color and features of the surface, averaged over the frames that see a vertex."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Num, UInt8
from scipy.spatial import KDTree

from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import Mesh, RayCaster, render_view

SEEN_WEIGHT = 0.05
"""total weight of its views above which a vertex counts as seen"""
LAST_CELL = 1.001
"""positions are clamped this far inside the picture, so that a cell follows to blend with"""


def visibility(
    mesh_agent: Mesh,
    agent_from_camera: Float[np.ndarray, "view 4 4"],
    intrinsics: Float[np.ndarray, "view 3 3"],
    size: tuple[int, int],
    tolerance_m: float = 0.01,
) -> tuple[Float[np.ndarray, "view vertex"], Float[np.ndarray, "view vertex 2"]]:
    """Return how squarely each view sees each vertex (0: hidden, 1: face to face) and at which color pixel.

    ``size`` is (height, width) of the color pictures; hidden means behind the mesh by more than the
    tolerance.
    """
    caster = RayCaster(mesh_agent)
    normals = mesh_agent.vertex_normals()
    vertices = mesh_agent.vertices.astype(float)
    coarse = (size[0] // 2, size[1] // 2)
    weights, pixels = [], []
    for pose, k in zip(agent_from_camera, intrinsics, strict=True):
        rendered, _ = render_view(caster, pose, cameras.scale_intrinsics(k, size, coarse), *coarse)
        pixel, depth = cameras.project(rigid.apply(rigid.inverse(pose), vertices), k)
        at = np.floor(pixel * [coarse[1] / size[1], coarse[0] / size[0]]).astype(int)
        inside = (depth > 0.1) & ((at >= 0) & (at < [coarse[1], coarse[0]])).all(1)
        at = np.where(inside[:, None], at, 0)
        seen = inside & (np.abs(rendered[at[:, 1], at[:, 0]] - depth) < tolerance_m)
        toward = pose[:3, 3] - vertices
        facing = (normals * toward).sum(1) / np.linalg.norm(toward, axis=1)
        weights.append(np.where(seen, np.clip(facing, 0, 1) ** 2, 0))
        pixels.append(pixel)
    return np.stack(weights), np.stack(pixels)


def on_mask(
    pixel: Float[np.ndarray, "vertex 2"], labels: UInt8[np.ndarray, "height width"]
) -> Bool[np.ndarray, "vertex"]:
    """Return which vertices project onto the mask (255): where a limb moved, other frames show the
    background.
    """
    height, width = labels.shape
    column, row = np.floor(pixel).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    return inside & (labels[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)] == 255)


def gather(
    vertices: Float[np.ndarray, "vertex 3"],
    weight: Float[np.ndarray, "view vertex"],
    pixel: Float[np.ndarray, "view vertex 2"],
    pictures: Sequence[Num[np.ndarray, "height width channel"]]
    | Num[np.ndarray, "view height width channel"],
    stride_px: int,
) -> Float[np.ndarray, "vertex channel"]:
    """Average pictures (one cell per ``stride_px`` color pixels) over the views; unseen vertices take the
    nearest seen one's.
    """
    total = sum(
        w[:, None] * _sample(picture, at / stride_px)
        for w, at, picture in zip(weight, pixel, pictures, strict=True)
    )
    seen = weight.sum(0) > SEEN_WEIGHT
    mean = total / np.maximum(weight.sum(0), 1e-9)[:, None]
    if seen.any() and not seen.all():
        mean[~seen] = mean[seen][KDTree(vertices[seen]).query(vertices[~seen])[1]]
    return mean


def _sample(
    picture: Num[np.ndarray, "height width channel"], position: Float[np.ndarray, "point 2"]
) -> Float[np.ndarray, "point channel"]:
    """Blend bilinearly at positions in cells; a cell's centre lies in the middle of its square."""
    height, width = picture.shape[:2]
    grid = np.clip(position - 0.5, 0, [width - LAST_CELL, height - LAST_CELL])
    low = np.floor(grid).astype(int)
    part = grid - low
    picture = picture.astype(np.float32)
    rows = [
        (1 - part[:, :1]) * picture[low[:, 1] + dy, low[:, 0]]
        + part[:, :1] * picture[low[:, 1] + dy, low[:, 0] + 1]
        for dy in (0, 1)
    ]
    return (1 - part[:, 1:]) * rows[0] + part[:, 1:] * rows[1]
