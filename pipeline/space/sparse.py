"""What structure from motion leaves behind: posed pictures and the points that they share, read from COLMAP's model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from pipeline.space import rigid

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True)
class Sparse:
    """One model: registered keyframes, points in the model's frame (arbitrary scale) and what sees them."""

    frame: Int[np.ndarray, key]
    model_from_camera: Float[np.ndarray, "key 4 4"]
    points_model: Float[np.ndarray, "point 3"]
    observed_point: Int[np.ndarray, observation]
    observed_key: Int[np.ndarray, observation]
    observed_pixel: Float[np.ndarray, "observation 2"]
    reprojection_px: float
    reconstruction: pycolmap.Reconstruction
    """COLMAP's own model, for its text files."""


def sparse_from_model(model: pycolmap.Reconstruction) -> Sparse:
    """Read a model whose pictures are named by six digits, the frame."""
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    key_of = {image.image_id: key for key, image in enumerate(images)}
    camera_from_model = np.stack([np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in images])
    identifiers = sorted(model.points3D)
    rows = [
        (point, key_of[element.image_id], *model.images[element.image_id].points2D[element.point2D_idx].xy)
        for point, identifier in enumerate(identifiers)
        for element in model.points3D[identifier].track.elements
    ]
    table = np.array(rows).reshape(-1, 4)
    return Sparse(
        frame=np.array([int(image.name[:6]) for image in images]),
        model_from_camera=rigid.inverse(camera_from_model),
        points_model=np.array([model.points3D[identifier].xyz for identifier in identifiers]).reshape(-1, 3),
        observed_point=table[:, 0].astype(int),
        observed_key=table[:, 1].astype(int),
        observed_pixel=table[:, 2:],
        reprojection_px=float(model.compute_mean_reprojection_error()),
        reconstruction=model,
    )
