"""Sparse reconstruction from structure from motion: registered keyframes, points and their observations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from pipeline.geometry import rigid

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True)
class SparseModel:
    """Registered keyframes, points in the model's frame (arbitrary scale) and their observations (colour
    pixels)."""

    frame: Int[np.ndarray, " key"]
    model_from_camera: Float[np.ndarray, "key 4 4"]
    points_model: Float[np.ndarray, "point 3"]
    observed_point: Int[np.ndarray, " observation"]
    observed_key: Int[np.ndarray, " observation"]
    observed_pixel: Float[np.ndarray, "observation 2"]
    reprojection_px: float
    reconstruction: pycolmap.Reconstruction
    """COLMAP's own model, for its text files."""


def read_sparse_model(model: pycolmap.Reconstruction) -> SparseModel:
    """Read a model whose pictures are named by six digits, the frame."""
    images = sorted(
        (image for image in model.images.values() if image.has_pose), key=lambda image: image.name
    )
    key_of_image = {image.image_id: key for key, image in enumerate(images)}
    camera_from_model = np.stack(
        [np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in images]
    )
    identifiers = sorted(model.points3D)
    rows = [
        (
            point,
            key_of_image[element.image_id],
            *model.images[element.image_id].points2D[element.point2D_idx].xy,
        )
        for point, identifier in enumerate(identifiers)
        for element in model.points3D[identifier].track.elements
    ]
    table = np.array(rows).reshape(-1, 4)
    return SparseModel(
        frame=np.array([int(image.name[:6]) for image in images]),
        model_from_camera=rigid.inverse(camera_from_model),
        points_model=np.array([model.points3D[identifier].xyz for identifier in identifiers]).reshape(-1, 3),
        observed_point=table[:, 0].astype(int),
        observed_key=table[:, 1].astype(int),
        observed_pixel=table[:, 2:],
        reprojection_px=float(model.compute_mean_reprojection_error()),
        reconstruction=model,
    )
