"""Where in the home the agent's root can be: cells above floor and furniture, and the steps between them."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from pipeline.models.fields import Field

CELL_M = 0.1
PROBE_M = 0.03
"""steps of the search for ground, down each column"""
CLEAR_M = 0.03
"""the root stays this far from surfaces, or, where it is usually lower, half as high as it usually is"""
STEP_M = 0.15
"""higher steps are jumps"""
LEAP_M = 1.0
"""and higher ones do not happen"""
HOME_CELLS = 2
"""the home reaches this far beyond columns in which anything was measured"""


@dataclass(frozen=True)
class Places:
    """Cells that the root can be in and the steps that lead from each to others."""

    position: Float[np.ndarray, "cell 3"]
    """of the root, world frame"""
    origin: Int[np.ndarray, "step"]
    target: Int[np.ndarray, "step"]
    """steps go both ways: each stands twice; they are sorted by target"""
    effort: Float[np.ndarray, "step"]
    """length in cells, jumps more"""

    def nearest(self, point: Float[np.ndarray, "3"]) -> int:
        """Return the cell nearest to a place."""
        return int(cKDTree(self.position).query(point)[1])

    def only(self, chosen: Bool[np.ndarray, "cell"]) -> "Places":
        """Keep some of the cells and the steps between them."""
        number = np.cumsum(chosen) - 1
        kept = chosen[self.origin] & chosen[self.target]
        return Places(self.position[chosen], number[self.origin[kept]], number[self.target[kept]], self.effort[kept])


def places_of(scene: Field, floor_m: float, roots: Float[np.ndarray, "root 3"]) -> Places:
    """Find the places of the home from where the root was seen: as high above the ground, and no higher up than ever.

    Ground is what the scene's surface bears, and the floor: what was never seen is taken for free.
    """
    low, high = (np.array(corner) for corner in (scene.shape.low_m, scene.shape.high_m))
    floor_m = max(floor_m, low[1])
    height = roots[:, 1] - _ground_below(scene, floor_m, roots)
    usual = float(np.median(height))
    top = max(float(roots[:, 1].max()), floor_m + usual) + STEP_M
    x, z = (np.arange(low[axis], high[axis] + CELL_M, CELL_M) for axis in (0, 2))
    column = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1)
    levels = np.arange(floor_m - PROBE_M, high[1], PROBE_M)
    probe = np.insert(np.repeat(column[:, :, None], len(levels), 2), 1, levels, axis=-1)
    distance = distances(scene, probe.reshape(-1, 3)).reshape(probe.shape[:-1])
    home = binary_dilation((distance < scene.shape.truncation_m - 1e-3).any(-1), iterations=HOME_CELLS)
    column, distance = column[home], distance[home][:, 2:]
    levels = levels[2:]
    distance = distance[:, levels < top]
    ground = np.zeros(distance.shape, bool)
    ground[:, 1:] = (distance[:, :-1] <= 0) & (distance[:, 1:] > 0)
    ground[:, 0] = distance[:, 0] > 0
    place, level = np.nonzero(ground)
    ground_m = np.where(level == 0, floor_m, levels[level] - PROBE_M / 2)
    position = np.stack([column[place, 0], ground_m + usual, column[place, 1]], axis=-1)
    position = position[(position[:, 1] <= top) & (distances(scene, position) > min(CLEAR_M, usual / 2))]
    return _connected(scene, position)


def _connected(scene: Field, position: Float[np.ndarray, "cell 3"]) -> Places:
    """Tie cells of neighbouring columns where nothing solid stands between."""
    flat = cKDTree(position[:, [0, 2]])
    first, second = flat.query_pairs(1.5 * CELL_M, output_type="ndarray").T
    climb = np.abs(position[first, 1] - position[second, 1])
    between = (position[first] + position[second]) / 2
    between[:, 1] = np.maximum(position[first, 1], position[second, 1])
    free = (climb < LEAP_M) & (distances(scene, between) > 0)
    first, second, climb = first[free], second[free], climb[free]
    effort = np.linalg.norm(position[first] - position[second], axis=1) / CELL_M + np.where(climb > STEP_M, 2 * climb / CELL_M, 0)
    origin, target, effort = np.concatenate([first, second]), np.concatenate([second, first]), np.tile(effort, 2)
    order = np.lexsort((origin, target))
    return Places(position, origin[order], target[order], effort[order])


def _ground_below(scene: Field, floor_m: float, roots: Float[np.ndarray, "root 3"]) -> Float[np.ndarray, "root"]:
    """Return the height of the first surface below each root, the floor's where there is none."""
    down = np.arange(0, max(float(roots[:, 1].max()) - floor_m, 0) + PROBE_M, PROBE_M)
    probe = roots[:, None] - down[:, None] * np.array([0.0, 1.0, 0.0])
    solid = (distances(scene, probe.reshape(-1, 3)).reshape(len(roots), -1) <= 0) | (probe[..., 1] <= floor_m)
    return np.maximum(np.where(solid.any(1), roots[:, 1] - down[solid.argmax(1)], floor_m), floor_m)


@torch.no_grad()
def distances(scene: Field, points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point"]:
    """Return signed distances from the scene that all videos share."""
    device = scene.log_beta.device
    parts = [torch.from_numpy(part).float().to(device) for part in np.array_split(points, max(1, len(points) // 200_000))]
    return np.concatenate([scene.distance_at(part, torch.full((len(part),), -1, device=device)).cpu().numpy() for part in parts])
