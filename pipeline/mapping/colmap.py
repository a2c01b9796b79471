"""Deterministic COLMAP: one CPU thread and fixed seeds.

`extract`, `match` and `mapping_options` make a model; `read_sparse_model` reads it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float, Int

from pipeline.geometry import rigid

GLOBAL_ADJUSTMENT_GROWTH = 1.3
"""Growth of the model that triggers global bundle adjustment; COLMAP's 1.1 takes twice as long."""
FIRST_PAIR_DEG = 6.0
"""Least triangulation angle of the initial pair, degrees: walk-throughs have small baselines."""
MIN_POSE_INLIERS = 20
"""Least PnP inliers of a registered picture; plain walls have few points."""


def seed_everything(seed: int) -> None:
    """Seed COLMAP's random numbers and log only its errors."""
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    pycolmap.set_random_seed(seed)


def pinhole(intrinsics: Float[np.ndarray, "3 3"]) -> pycolmap.ImageReaderOptions:
    """Return reader options of a pinhole camera with known intrinsics, pixels."""
    parameters = [intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]]
    return pycolmap.ImageReaderOptions(
        camera_model="PINHOLE", camera_params=",".join(f"{value:.6f}" for value in parameters)
    )


def extract(
    database: Path,
    pictures: Path,
    names: list[str],
    reader: pycolmap.ImageReaderOptions,
    sift: dict[str, int | float],
) -> None:
    """Extract SIFT features in pictures of one camera; ``sift`` overrides COLMAP's options by name."""
    extraction = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    for option, value in sift.items():
        setattr(extraction.sift, option, value)
    pycolmap.extract_features(
        database, pictures, names, pycolmap.CameraMode.SINGLE, reader, extraction, pycolmap.Device.cpu
    )


def match(database: Path, pairs: Iterable[tuple[str, str]], seed: int) -> None:
    """Match and geometrically verify pairs of picture names; writes pairs.txt beside the database."""
    listing = database.parent / "pairs.txt"
    listing.write_text("".join(f"{first} {second}\n" for first, second in pairs))
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pairing = pycolmap.ImportedPairingOptions(match_list_path=listing)
    pycolmap.match_image_pairs(database, matching, pairing, verification, device=pycolmap.Device.cpu)


def mapping_options(seed: int, *, calibrate: bool = False) -> pycolmap.IncrementalPipelineOptions:
    """Return options of incremental mapping; ``calibrate`` also refines focal length and distortion."""
    mapping = pycolmap.IncrementalPipelineOptions(
        num_threads=1,
        random_seed=seed,
        ba_refine_focal_length=calibrate,
        ba_refine_extra_params=calibrate,
        ba_global_frames_ratio=GLOBAL_ADJUSTMENT_GROWTH,
        ba_global_points_ratio=GLOBAL_ADJUSTMENT_GROWTH,
    )
    mapping.mapper.num_threads, mapping.mapper.random_seed, mapping.triangulation.random_seed = 1, seed, seed
    mapping.mapper.abs_pose_refine_focal_length = mapping.mapper.abs_pose_refine_extra_params = calibrate
    mapping.mapper.init_min_tri_angle = FIRST_PAIR_DEG
    mapping.mapper.abs_pose_min_num_inliers = MIN_POSE_INLIERS
    return mapping


def largest(models: Mapping[int, pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    """Return the model with most registered pictures, then points; None without any."""
    return max(models.values(), key=lambda each: (each.num_reg_images(), each.num_points3D()), default=None)


@dataclass(frozen=True)
class SparseModel:
    """Registered keyframes, points in the model's frame (arbitrary scale), observations in color pixels."""

    frame: Int[np.ndarray, " key"]
    model_from_camera: Float[np.ndarray, "key 4 4"]
    points_model: Float[np.ndarray, "point 3"]
    observed_point: Int[np.ndarray, " observation"]
    observed_key: Int[np.ndarray, " observation"]
    observed_pixel: Float[np.ndarray, "observation 2"]
    reprojection_px: float
    reconstruction: pycolmap.Reconstruction
    """The COLMAP model itself, for export."""


def read_sparse_model(model: pycolmap.Reconstruction) -> SparseModel:
    """Read a model whose picture names start with the six-digit frame number."""
    images = sorted(
        (image for image in model.images.values() if image.has_pose), key=lambda image: image.name
    )
    key_of_image = {image.image_id: key for key, image in enumerate(images)}
    camera_from_model = np.stack(
        [np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in images]
    )
    identifiers = sorted(model.points3D)
    rows = []
    for point, identifier in enumerate(identifiers):
        for element in model.points3D[identifier].track.elements:
            pixel = model.images[element.image_id].points2D[element.point2D_idx].xy
            rows.append((point, key_of_image[element.image_id], *pixel))
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
