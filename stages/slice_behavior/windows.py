"""The list of training and test windows, and the voxels where an animal may be."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_dilation

from pipeline.behavior.path_encoding import REST_SPEED_M_S
from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.support import height_ranges, mark_supported, with_headroom
from pipeline.behavior.trajectories import FUTURE, PAST, RATE_HZ, BehaviorData, Trajectory
from pipeline.data import npz
from stages.slice_behavior.floor import with_filled_floor, with_level_floor

REACH_VOXELS = 2
"""Radius around visited places that is allowed whatever the map: the error of the root, voxels."""


def slice_windows(
    trajectories: dict[str, Trajectory],
    test: frozenset[str],
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"],
    *,
    stride: int,
    past: int = PAST,
    rate_hz: float = RATE_HZ,
) -> BehaviorData:
    """List the windows of all recordings: training ones every ``stride`` frames, all test ones.

    They have ``past`` known frames; the future is as long as `FUTURE` at `RATE_HZ`, in multiples of four
    frames.
    """
    videos = tuple(sorted(trajectories))
    tested, none = np.array([v in test for v in videos]), np.zeros(0, np.int32)
    lengths = stride, 4 * max(round(FUTURE / RATE_HZ * rate_hz / 4), 1), past, rate_hz
    return BehaviorData(trajectories, agent_from_bone_rest, none, none, tested, videos, *lengths).sliced()


def allowed_voxels(
    volume: FeatureVolume, trajectories: Iterable[Trajectory], *, reach_voxels: int, rate_hz: float = RATE_HZ
) -> UInt8[np.ndarray, "x y z"]:
    """Return 1 where the animal's root may be: seen as free, or within ``reach_voxels`` of visited voxels; 2
    right above solid voxels, and 3 above filled floor.
    """
    visited, moving = np.zeros(volume.occupancy.shape, bool), [np.zeros((0, 3))]
    for root, moves in (roots_of(trajectory, rate_hz) for trajectory in trajectories):
        voxel, inside = volume.voxel(root)
        visited[tuple(voxel[inside].T)] = True
        moving.append(root[moves])
    if reach_voxels > 0 and visited.any():
        visited = binary_dilation(visited, iterations=reach_voxels)
    marks = mark_supported((volume.occupancy == 0) | visited, volume.occupancy)
    marks = with_filled_floor(marks, volume.occupancy, visited)
    return with_level_floor(marks, volume, np.concatenate(moving))


def roots_of(
    trajectory: Trajectory, rate_hz: float
) -> tuple[Float[np.ndarray, "frame 3"], Bool[np.ndarray, "frame"]]:
    """Return valid root positions, and whether the animal moves there."""
    root, valid = trajectory.world_from_agent[:, :3, 3], trajectory.valid
    speed = np.linalg.norm(np.diff(root[:, [0, 2]], axis=0, prepend=root[:1, [0, 2]]), axis=-1) * rate_hz
    return root[valid], (speed > REST_SPEED_M_S)[valid]


def write_volumes(
    folder: Path,
    volumes: tuple[FeatureVolume, ...],
    seen: Mapping[str, Trajectory],
    videos: tuple[str, ...],
    rate_hz: float,
) -> None:
    """Write `volume.npz`, or `volumes/<id>.npz` where each recording has its own scene.

    ``seen`` are the training recordings, which determine the visited voxels.
    """
    shared = len(volumes) == 1
    been = [list(seen.values())] if shared else [[seen[id]] if id in seen else [] for id in videos]
    scenes = list(zip(volumes, been, strict=True))
    marks = [allowed_voxels(*scene, reach_voxels=REACH_VOXELS, rate_hz=rate_hz) for scene in scenes]
    stays = zip(scenes, marks, strict=True)
    stands_m = height_ranges(
        (volume, allowed, *roots_of(track, rate_hz))
        for (volume, tracks), allowed in stays
        for track in tracks
    )
    files = [folder / "volume.npz"] if shared else [folder / "volumes" / f"{id}.npz" for id in videos]
    files[0].parent.mkdir(exist_ok=True)
    for file, volume, allowed in zip(files, volumes, marks, strict=True):
        fitting = with_headroom(allowed, volume.voxel_m, stands_m)
        npz.save(file, compress=True, **vars(volume), allowed=fitting, stands_m=stands_m)
