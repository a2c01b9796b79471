"""Space carving by masks: which cells the frames see through beside the animal, and which they see on it."""

import numpy as np
from jaxtyping import Float, Int, UInt8
from numba import njit

from pipeline.geometry import rigid


class Silhouettes:
    """Per cell of a grid: in how many frames its ray passes beside the animal and in how many it meets the
    animal's picture.
    """

    def __init__(self, origin: Float[np.ndarray, "3"], shape: tuple[int, int, int], voxel_m: float):
        self.origin, self.voxel_m = np.asarray(origin, float), voxel_m
        self.off_mask: Int[np.ndarray, "x y z"] = np.zeros(shape, np.int32)
        self.within: Int[np.ndarray, "x y z"] = np.zeros(shape, np.int32)

    def add(
        self,
        labels: UInt8[np.ndarray, "height width"],
        depth: Float[np.ndarray, "height width"],
        intrinsics: Float[np.ndarray, "3 3"],
        world_from_camera: Float[np.ndarray, "4 4"],
    ) -> None:
        """Count one frame; labels 255 animal, 0 not, 128 unknown. A ray off the mask counts for cells before
        its depth only.
        """
        camera_from_world = rigid.inverse(world_from_camera)
        start = camera_from_world[:3, :3] @ self.origin + camera_from_world[:3, 3]
        steps = np.ascontiguousarray(camera_from_world[:3, :3].T * self.voxel_m)
        _count(
            self.off_mask,
            self.within,
            start,
            steps,
            labels,
            np.ascontiguousarray(depth, np.float32),
            intrinsics,
        )

    def share_off_mask(self) -> Float[np.ndarray, "x y z"]:
        """Return the share of the frames that see a cell beside the animal; 0 where none sees it at all."""
        return self.off_mask / np.maximum(self.off_mask + self.within, 1)


@njit(cache=True, nogil=True)
def _count(off_mask, within, start, steps, labels, depth, intrinsics):
    height, width = labels.shape
    for i in range(off_mask.shape[0]):
        for j in range(off_mask.shape[1]):
            x0 = start[0] + i * steps[0, 0] + j * steps[1, 0]
            y0 = start[1] + i * steps[0, 1] + j * steps[1, 1]
            z0 = start[2] + i * steps[0, 2] + j * steps[1, 2]
            for k in range(off_mask.shape[2]):
                z = z0 + k * steps[2, 2]
                if z < 0.1:
                    continue
                column = int(np.floor((x0 + k * steps[2, 0]) / z * intrinsics[0, 0] + intrinsics[0, 2]))
                row = int(np.floor((y0 + k * steps[2, 1]) / z * intrinsics[1, 1] + intrinsics[1, 2]))
                if row < 0 or column < 0 or row >= height or column >= width:
                    continue
                if labels[row, column] == 255:
                    within[i, j, k] += 1
                elif labels[row, column] == 0 and depth[row, column] > z:
                    off_mask[i, j, k] += 1
