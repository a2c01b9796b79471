"""Writing feature volumes with the places where an animal may be."""

from collections.abc import Mapping
from pathlib import Path

from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.trajectories import Trajectory
from pipeline.data import npz
from stages.slice_behavior.windows import allowed_voxels, standing_heights

REACH_VOXELS = 2
"""Voxels around visited places in which the animal may be, whatever the map says: its root errs by as much.
"""


def write_volumes(
    folder: Path,
    volumes: tuple[FeatureVolume, ...],
    seen: Mapping[str, Trajectory],
    videos: tuple[str, ...],
    rate_hz: float,
) -> None:
    """Write `volume.npz`, or `volumes/<id>.npz` where each recording has its own scene.

    ``seen`` are the training recordings: only where they went counts as visited.
    """
    scene = dict(zip(videos, volumes if len(volumes) > 1 else volumes * len(videos), strict=True))
    stands_m = standing_heights(((scene[id], trajectory) for id, trajectory in seen.items()), rate_hz)
    if len(volumes) == 1:
        allowed = allowed_voxels(volumes[0], dict(seen), reach_voxels=REACH_VOXELS)
        npz.save(folder / "volume.npz", compress=True, **vars(volumes[0]), allowed=allowed, stands_m=stands_m)
        return
    (folder / "volumes").mkdir()
    for id, volume in zip(videos, volumes, strict=True):
        visited = {id: seen[id]} if id in seen else {}
        allowed = allowed_voxels(volume, visited, reach_voxels=REACH_VOXELS)
        npz.save(
            folder / "volumes" / f"{id}.npz",
            compress=True,
            **vars(volume),
            allowed=allowed,
            stands_m=stands_m,
        )
