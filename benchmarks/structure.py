"""Cameras by structure from motion on colour pictures alone: a reference in which neither the depth sensor nor
its tracking has a part.

COLMAP on evenly chosen pictures of a 7-Scenes style folder, one camera whose focal length and distortion are
refined. It knows no metres: `scaled` brings it to the scale of what is judged.
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
"""What refinement begins with: a Kinect's colour camera."""
PICTURES = 168
"""Enough for pictures half a second apart in a minute; all pairs of them are matched."""


def cameras(scene: Path, numbers: list[int], folder: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Return ``world_from_camera`` per frame number, in units of its own; computed once per ``folder``."""
    done = folder / "structure.npz"
    if not done.is_file():
        _solve(scene, numbers, folder, done)
    table = npz.load(done)
    return dict(zip(table["number"].tolist(), table["world_from_camera"], strict=True))


def _solve(scene: Path, numbers: list[int], folder: Path, done: Path) -> None:
    chosen = np.unique(np.linspace(0, len(numbers) - 1, min(PICTURES, len(numbers))).round().astype(int))
    shutil.rmtree(folder, ignore_errors=True)
    pictures = folder / "pictures"
    pictures.mkdir(parents=True)
    for index in chosen:
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
    npz.save(done, number=model.frame, world_from_camera=model.model_from_camera)


def scaled(
    ours: Float[np.ndarray, "frame 4 4"], reference: Float[np.ndarray, "frame 4 4"]
) -> Float[np.ndarray, ""]:
    """Return the factor that brings the reference's units to those of ours, by least squares over all
    camera centres; NaN in ours does not count.
    """
    known = np.isfinite(ours).all((1, 2)) & np.isfinite(reference).all((1, 2))
    ours, reference = ours[known], reference[known]
    rotation = rigid.mean_rotation((ours @ rigid.inverse(reference))[:, :3, :3])
    place = ours[:, :3, 3] - ours[:, :3, 3].mean(0)
    other = (reference[:, :3, 3] - reference[:, :3, 3].mean(0)) @ rotation.T
    return (place * other).sum() / (other**2).sum()


def in_world(
    ours: Float[np.ndarray, "frame 4 4"],
    reference: Float[np.ndarray, "frame 4 4"],
    other: Float[np.ndarray, "some 4 4"],
    *,
    resize: bool = True,
) -> Float[np.ndarray, "some 4 4"]:
    """Return ``other`` cameras of the reference in the world and units of ours: one similarity, fitted to the
    frames that ``ours`` and ``reference`` share; a rigid motion without ``resize``.
    """
    factor = scaled(ours, reference) if resize else np.array(1.0)
    return constant_between(ours, _resized(reference, factor)) @ _resized(other, factor)


def _resized(
    poses: Float[np.ndarray, "frame 4 4"], factor: Float[np.ndarray, ""]
) -> Float[np.ndarray, "frame 4 4"]:
    sized = poses.copy()
    sized[:, :3, 3] *= factor
    return sized
