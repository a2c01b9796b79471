"""COLMAP as every room runs it: on one CPU thread and with fixed seeds, so that the same pictures give the same model."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float


def seed_everything(seed: int) -> None:
    """Fix COLMAP's own random numbers and keep all but its errors quiet."""
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    pycolmap.set_random_seed(seed)


def pinhole(intrinsics: Float[np.ndarray, "3 3"]) -> pycolmap.ImageReaderOptions:
    """Return how pictures of one known lens are read; pixels."""
    told = [intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]]
    return pycolmap.ImageReaderOptions(camera_model="PINHOLE", camera_params=",".join(f"{value:.6f}" for value in told))


def extract(database: Path, pictures: Path, names: list[str], reader: pycolmap.ImageReaderOptions, sift: dict[str, int | float]) -> None:
    """Find SIFT features, of which ``sift`` names the options, in pictures of one camera."""
    extraction = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    for option, value in sift.items():
        setattr(extraction.sift, option, value)
    pycolmap.extract_features(database, pictures, names, pycolmap.CameraMode.SINGLE, reader, extraction, pycolmap.Device.cpu)


def match(database: Path, pairs: Iterable[tuple[str, str]], seed: int) -> None:
    """Match and verify pairs of pictures, named as they were extracted; the list of them is left beside the database."""
    listing = database.parent / "pairs.txt"
    listing.write_text("".join(f"{first} {second}\n" for first, second in pairs))
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pairing = pycolmap.ImportedPairingOptions(match_list_path=listing)
    pycolmap.match_image_pairs(database, matching, pairing, verification, device=pycolmap.Device.cpu)


def mapping_options(seed: int, *, calibrate: bool = False) -> pycolmap.IncrementalPipelineOptions:
    """Return options of incremental mapping; the lens is refined only to ``calibrate`` it."""
    mapping = pycolmap.IncrementalPipelineOptions(
        num_threads=1,
        random_seed=seed,
        ba_refine_focal_length=calibrate,
        ba_refine_extra_params=calibrate,
        ba_global_frames_ratio=1.3,
        ba_global_points_ratio=1.3,
    )
    mapping.mapper.num_threads, mapping.mapper.random_seed, mapping.triangulation.random_seed = 1, seed, seed
    mapping.mapper.abs_pose_refine_focal_length = mapping.mapper.abs_pose_refine_extra_params = calibrate
    mapping.mapper.init_min_tri_angle = 6.0
    mapping.mapper.abs_pose_min_num_inliers = 20
    return mapping
