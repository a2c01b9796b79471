"""Camera poses by structure from motion on color pictures alone, a reference that is independent of the depth sensor
and its tracking.

Runs COLMAP on evenly sampled pictures of a 7-Scenes style folder, with one camera whose focal length and distortion
are refined. The result has no metric scale; `in_world` aligns it to the evaluated cameras.
"""

import shutil
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float

from pipeline.core.progress import log
from pipeline.data import npz
from pipeline.geometry import rigid
from pipeline.mapping import colmap
from pipeline.mapping.colmap import read_sparse_model
from pipeline.metrics.pose_errors import constant_between

FOCAL_PX, CENTER_PX = 525.0, "320,240"
"""Initial intrinsics: the color camera of a Kinect."""
MAX_PICTURES = 168
"""Maximal number of pictures, since all pairs are matched."""


def cameras(scene: Path, numbers: list[int], folder: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Return ``world_from_camera`` per frame number, in arbitrary units; cached in ``folder``."""
    output = folder / "structure.npz"
    if not output.is_file():
        _solve(scene, numbers, folder, output)
    table = npz.load(output)
    return dict(zip(table["number"].tolist(), table["world_from_camera"], strict=True))


def _solve(scene: Path, numbers: list[int], folder: Path, output: Path) -> None:
    indices = np.unique(np.linspace(0, len(numbers) - 1, min(MAX_PICTURES, len(numbers))).round().astype(int))
    shutil.rmtree(folder, ignore_errors=True)
    pictures = folder / "pictures"
    pictures.mkdir(parents=True)
    for index in indices:
        name = f"{numbers[index]:06d}"
        shutil.copy(next(scene.glob(f"frame-{name}.color.*")), pictures / f"{name}.jpg")
    names = sorted(path.name for path in pictures.iterdir())
    colmap.seed_everything(0)
    reader = pycolmap.ImageReaderOptions(
        camera_model="SIMPLE_RADIAL", camera_params=f"{FOCAL_PX},{CENTER_PX},0"
    )
    database = folder / "database.db"
    colmap.extract(database, pictures, names, reader, {})
    colmap.match(database, ((a, b) for i, a in enumerate(names) for b in names[i + 1 :]), 0)
    options = colmap.mapping_options(0, calibrate=True)
    models = pycolmap.incremental_mapping(database, pictures, folder / "sparse", options)
    model = read_sparse_model(max(models.values(), key=lambda model: model.num_reg_images()))
    log(f"structure: {len(model.frame)} of {len(names)} pictures, {model.reprojection_px:.2f} px")
    npz.save(output, number=model.frame, world_from_camera=model.model_from_camera)


def scale_to(
    ours: Float[np.ndarray, "frame 4 4"], reference: Float[np.ndarray, "frame 4 4"]
) -> Float[np.ndarray, ""]:
    """Return the scale from the units of the reference to ours, by least squares over all camera centers; NaN poses are
    ignored.
    """
    known = np.isfinite(ours).all((1, 2)) & np.isfinite(reference).all((1, 2))
    ours, reference = ours[known], reference[known]
    rotation = rigid.mean_rotation((ours @ rigid.inverse(reference))[:, :3, :3])
    centers = ours[:, :3, 3] - ours[:, :3, 3].mean(0)
    other = (reference[:, :3, 3] - reference[:, :3, 3].mean(0)) @ rotation.T
    return (centers * other).sum() / (other**2).sum()


def in_world(
    ours: Float[np.ndarray, "frame 4 4"],
    reference: Float[np.ndarray, "frame 4 4"],
    other: Float[np.ndarray, "some 4 4"],
    *,
    resize: bool = True,
) -> Float[np.ndarray, "some 4 4"]:
    """Transform ``other`` cameras of the reference to our world by a similarity fitted to the shared frames of ``ours``
    and ``reference``; a rigid transform without ``resize``.
    """
    factor = scale_to(ours, reference) if resize else np.array(1.0)
    return constant_between(ours, _scaled(reference, factor)) @ _scaled(other, factor)


def _scaled(
    poses: Float[np.ndarray, "frame 4 4"], factor: Float[np.ndarray, ""]
) -> Float[np.ndarray, "frame 4 4"]:
    scaled = poses.copy()
    scaled[:, :3, 3] *= factor
    return scaled
