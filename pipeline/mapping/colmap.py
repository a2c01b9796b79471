"""COLMAP on one CPU thread and with fixed seeds, so that the same pictures give the same model."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float

GLOBAL_ADJUSTMENT_GROWTH = 1.3
"""Global bundle adjustment after the model grew by this factor; COLMAP's 1.1 takes twice the time for equal
models."""
FIRST_PAIR_DEG = 6.0
"""Least triangulation angle of the first pair, degrees: walks through a room have small baselines."""
LEAST_POSE_INLIERS = 20
"""Points a picture must share with the model to be registered; plain walls have few."""


def seed_everything(seed: int) -> None:
    """Fix COLMAP's own random numbers and keep all but its errors quiet."""
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
    """Extract SIFT features in pictures of one camera; ``sift`` sets COLMAP's options by name."""
    extraction = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    for option, value in sift.items():
        setattr(extraction.sift, option, value)
    pycolmap.extract_features(
        database, pictures, names, pycolmap.CameraMode.SINGLE, reader, extraction, pycolmap.Device.cpu
    )


def match(database: Path, pairs: Iterable[tuple[str, str]], seed: int) -> None:
    """Match and verify pairs of picture names; the list is left beside the database as pairs.txt."""
    listing = database.parent / "pairs.txt"
    listing.write_text("".join(f"{first} {second}\n" for first, second in pairs))
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pairing = pycolmap.ImportedPairingOptions(match_list_path=listing)
    pycolmap.match_image_pairs(database, matching, pairing, verification, device=pycolmap.Device.cpu)


def mapping_options(seed: int, *, calibrate: bool = False) -> pycolmap.IncrementalPipelineOptions:
    """Return options of incremental mapping; ``calibrate`` also refines the focal length and the
    distortion."""
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
    mapping.mapper.abs_pose_min_num_inliers = LEAST_POSE_INLIERS
    return mapping
