"""Writing feature volumes with the places where an animal may be."""

from collections.abc import Mapping
from pathlib import Path

from pipeline.files import arrays
from pipeline.models.perception import FeatureVolume
from pipeline.models.trajectories import Trajectory
from stages.slice_behavior.windows import allowed_voxels


def write_volumes(
    folder: Path, volumes: tuple[FeatureVolume, ...], seen: Mapping[str, Trajectory], videos: tuple[str, ...], *, reach_voxels: int
) -> None:
    """Write `volume.npz`, or `volumes/<id>.npz` where each recording has its own scene.

    ``seen`` are the training recordings: only where they went counts as visited.
    """
    if len(volumes) == 1:
        allowed = allowed_voxels(volumes[0], dict(seen), reach_voxels=reach_voxels)
        arrays.save(folder / "volume.npz", compress=True, **vars(volumes[0]), allowed=allowed)
        return
    (folder / "volumes").mkdir()
    for id, volume in zip(videos, volumes, strict=True):
        visited = {id: seen[id]} if id in seen else {}
        allowed = allowed_voxels(volume, visited, reach_voxels=reach_voxels)
        arrays.save(folder / "volumes" / f"{id}.npz", compress=True, **vars(volume), allowed=allowed)
