"""Feature-metric correspondences between a frame's features and the template's, rendered from its pose.

Feature-metric alignment minimizes sum |F_observed(pi(T X)) - F_template(X)|^2 over the camera T (the paper's
Eq. 6; PixLoc, Sarlin et al. 2021). Its Gauss-Newton step on each cell of the feature grid is written as
correspondences of `pipeline.mapping.pose_optimization`: one along each eigenvector of the cell's structure
tensor, weighted by its eigenvalue.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.data.clips import Clip, Masks
from pipeline.data.features import STRIDE_PX
from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import RayCaster, render_view
from pipeline.mapping.pose_optimization import MAP, Correspondences

SIGMA = 4.0
"""Standard deviation of a unit-length feature; channels and neighboring cells have correlated errors. On
the toy's two sessions positions gain 0.3 mm of 4.0 and 4.6 mm; at 1 one session turns by 0.07 degrees."""
MAX_STEP_CELLS = 1.0
"""Longest step, cells: the linear range of features."""
MIN_EIGENVALUE = 0.005
"""Least eigenvalue of the structure tensor, squared feature change per cell; rejects plain walls."""
MIN_NORM = 0.5
"""Least norm of rendered features; shorter ones mix in unseen vertices."""
MAX_DEPTH_ERROR_M = 0.12
"""Largest difference of measured and template depth, meters; rejects moved objects."""
MIN_CELLS = 20
"""Least number of comparable cells."""


@dataclass(frozen=True)
class FeatureMap:
    """The template with a feature per vertex, and a session's features at stride 8."""

    caster: RayCaster
    vertex_features: Float[np.ndarray, "vertex channel"]
    frame_features: Float[np.ndarray, "frame rows columns channel"]


def feature_correspondences(
    clip: Clip, masks: Masks, scene: FeatureMap, frame: int, world_from_camera: Float[np.ndarray, "4 4"]
) -> Correspondences | None:
    """Return one frame's feature-metric correspondences; None if too few cells are comparable."""
    observed = np.asarray(scene.frame_features[frame], np.float32)
    rows, columns, channels = observed.shape
    intrinsics = clip.intrinsics[frame].copy()
    intrinsics[:2] /= STRIDE_PX
    depth, hits = render_view(scene.caster, world_from_camera, intrinsics, rows, columns)
    rendered = hits.interpolate(scene.caster.mesh, scene.vertex_features).reshape(rows, columns, channels)
    norm = np.linalg.norm(rendered, axis=-1, keepdims=True)
    rendered = rendered / np.maximum(norm, MIN_NORM)
    rays = cameras.ray_directions(intrinsics, rows, columns)
    measured = cameras.lookup_depth(clip.depth(frame), clip.depth_intrinsics[frame], rays)
    free = cv2.erode((masks[frame] == 0).astype(np.uint8), np.ones((2 * STRIDE_PX + 1,) * 2, np.uint8))
    corner = STRIDE_PX // 2
    free = free[corner::STRIDE_PX, corner::STRIDE_PX][:rows, :columns] > 0
    good = free & (depth > 0) & (norm[..., 0] > MIN_NORM) & (np.abs(measured - depth) < MAX_DEPTH_ERROR_M)
    good[[0, -1]] = good[:, [0, -1]] = False
    if good.sum() < MIN_CELLS:
        return None
    gradient = np.stack([np.gradient(observed, axis=1), np.gradient(observed, axis=0)], axis=-1)[good]
    tensor = np.swapaxes(gradient, 1, 2) @ gradient
    rhs = np.einsum("mck,mc->mk", gradient, (rendered - observed)[good])
    eigenvalue, axes = np.linalg.eigh(tensor)
    center, z = cameras.pixel_grid(rows, columns)[good], depth[good]
    ray = cameras.unproject(center, intrinsics)
    points_map = rigid.apply(world_from_camera, ray * z[:, None])
    parts = []
    for index in range(2):
        axis, precision = axes[..., index], np.maximum(eigenvalue[:, index], MIN_EIGENVALUE)
        step = np.einsum("mk,mk->m", axis, rhs) / precision
        valid = (eigenvalue[:, index] > MIN_EIGENVALUE) & (np.abs(step) < MAX_STEP_CELLS)
        moved = cameras.unproject(center + step[:, None] * axis, intrinsics) * z[:, None]
        # Gradient of the pixel by the point, times depth over focal length: perpendicular to the ray.
        across = np.column_stack([axis, -(axis * ray[:, :2]).sum(1)])
        direction = across @ world_from_camera[:3, :3].T
        sigma = SIGMA * z / (intrinsics[0, 0] * np.sqrt(precision))
        count = int(valid.sum())
        parts.append(
            Correspondences(
                np.full(count, frame), np.full(count, MAP), moved[valid], points_map[valid], direction[valid],
                sigma[valid],
            )
        )  # fmt: skip
    return Correspondences.join(*parts)
