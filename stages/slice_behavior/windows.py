"""The exact list of training and test windows, and where in the room an animal may be."""

import numpy as np
from jaxtyping import UInt8
from scipy.ndimage import binary_dilation

from pipeline.models.perception import FeatureVolume
from pipeline.models.trajectories import FUTURE, PAST, TEST, TRAIN, BehaviorData, Trajectory, window_starts


def slice_windows(
    trajectories: dict[str, Trajectory], test: frozenset[str], agent_from_bone_rest: np.ndarray, *, stride: int
) -> BehaviorData:
    """List the windows of every recording: with ``stride`` in training recordings, every one in test recordings."""
    videos = tuple(sorted(trajectories))
    starts = [window_starts(trajectories[v].valid, PAST + FUTURE, 1 if v in test else stride) for v in videos]
    video = np.repeat(np.arange(len(videos)), [len(s) for s in starts]).astype(np.int32)
    tested = np.array([v in test for v in videos])
    split = np.where(tested[video], TEST, TRAIN).astype(np.uint8)
    start = np.concatenate(starts).astype(np.int32)
    return BehaviorData({v: trajectories[v] for v in videos}, agent_from_bone_rest, video, start, split, videos)


def allowed_voxels(volume: FeatureVolume, trajectories: dict[str, Trajectory], *, reach_voxels: int) -> UInt8[np.ndarray, "x y z"]:
    """Return 1 where the animal's root may be: seen as free, or within ``reach_voxels`` of where it has been."""
    visited = np.zeros(volume.occupancy.shape, bool)
    for trajectory in trajectories.values():
        voxel, inside = volume.voxel(trajectory.world_from_agent[trajectory.valid, :3, 3])
        visited[tuple(voxel[inside].T)] = True
    if reach_voxels > 0 and visited.any():
        visited = binary_dilation(visited, iterations=reach_voxels)
    return ((volume.occupancy == 0) | visited).astype(np.uint8)
