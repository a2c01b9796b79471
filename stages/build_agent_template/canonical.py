"""The agent's own axes (origin in the middle of the body, +y up, +z towards the head) and its Gaussian bones.

Bones cluster the body's voxels by geodesic distance. Farthest-point seeds reach every paw, the tail's tip and
the head first; a few iterations of k-medoids refine them, with more weight on thin parts so that limbs get
bones of their own.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from pipeline.geometry import rigid
from pipeline.geometry.ground import GroundPlane

END_SHARE = 0.18
"""share of the body's length that counts as an end"""
MEDOID_ITERATIONS = 6
"""iterations of k-medoids"""
MAX_CELLS = 5000
"""largest number of voxels used"""
SCALE_FACTOR, MIN_SCALE_M = 1.3, 0.012
"""scale of a bone in standard deviations of its voxels (larger blends softer), and the smallest scale"""
DENSITY_RADIUS_M = 0.04
"""radius for the density of voxels, whose inverse is their weight: limbs are thin"""


@dataclass(frozen=True)
class Heading:
    """Heading of the body in the turnaround's world, and its evidence."""

    world_from_agent: Float[np.ndarray, "4 4"]
    head_share: float
    """the head end's share of volume times height over both ends (0.5 = ambiguous)"""
    elongation: float
    """ratio of horizontal extents along and across the axis (1 = ambiguous)"""


def find_heading(inside_world: Float[np.ndarray, "cell 3"], ground: GroundPlane, turn_deg: float) -> Heading:
    """Choose +z along the longest horizontal axis of the body, towards the end with more and higher volume.

    The head is thick and high, the tail thin, and the rump of a curled animal low. An animal that stands
    upright or lies curled may be wider than long: ``turn_deg``, counterclockwise from above, corrects this.
    """
    center = np.median(inside_world, axis=0)
    level = (inside_world - inside_world.mean(0))[:, [0, 2]]
    variance, axes = np.linalg.eigh(level.T @ level)
    axis = axes[:, -1]
    axis = axis if axis[np.abs(axis).argmax()] > 0 else -axis
    along = (inside_world - center)[:, [0, 2]] @ axis
    end = END_SHARE * np.ptp(along)
    height = np.maximum(ground.above(inside_world), 0)
    ahead, behind = height[along > along.max() - end].sum(), height[along < along.min() + end].sum()
    share = max(ahead, behind) / max(ahead + behind, 1e-9)
    if behind > ahead:
        axis = -axis
    up = np.array([0.0, 1.0, 0.0])
    forward = rigid.exp(np.r_[np.radians(turn_deg) * up, 0, 0, 0])[:3, :3] @ np.array([axis[0], 0, axis[1]])
    world_from_agent = rigid.make(np.stack([np.cross(up, forward), up, forward], axis=1), center)
    return Heading(world_from_agent, float(share), float(np.sqrt(variance[1] / max(variance[0], 1e-12))))


@dataclass(frozen=True)
class Bones:
    """Gaussian bones at rest in the agent frame."""

    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]
    bone_scale_m: Float[np.ndarray, "bone 3"]


def fit_bones(
    inside_agent: Float[np.ndarray, "cell 3"], voxel_m: float, bones: int, rng: np.random.Generator
) -> Bones:
    """Cluster the body's voxels (agent frame) into bones, front to back; a bone's z is its longest axis."""
    cells = inside_agent[np.sort(rng.permutation(len(inside_agent))[:MAX_CELLS])]
    graph = neighbor_graph(cells, voxel_m * max(1.0, (len(inside_agent) / len(cells)) ** (1 / 3)))
    near = KDTree(inside_agent).query_ball_point(cells, DENSITY_RADIUS_M, return_length=True)
    label = k_medoids(graph, cells, 1.0 / np.maximum(near, 1), bones)
    frames, scales = [], []
    for bone in range(bones):
        own = cells[label == bone]
        middle = own.mean(0)
        variance, axes = np.linalg.eigh(np.cov((own - middle).T) if len(own) > 3 else np.eye(3) * voxel_m**2)
        axes *= np.where(axes[np.abs(axes).argmax(0), range(3)] < 0, -1, 1)
        axes[:, 0] = np.cross(axes[:, 1], axes[:, 2])
        frames.append(rigid.make(axes, middle))
        scales.append(np.maximum(SCALE_FACTOR * np.sqrt(np.maximum(variance, 0)), MIN_SCALE_M))
    order = np.argsort([-frame[2, 3] for frame in frames])
    return Bones(np.stack(frames)[order], np.stack(scales)[order])


def neighbor_graph(cells: Float[np.ndarray, "cell 3"], spacing_m: float) -> scipy.sparse.csr_matrix:
    """Connect voxels within two spacings, weighted by distance; join components at their nearest points."""
    pairs = KDTree(cells).query_pairs(2 * spacing_m, output_type="ndarray")
    length = np.linalg.norm(cells[pairs[:, 0]] - cells[pairs[:, 1]], axis=1)
    graph = scipy.sparse.coo_matrix((length, pairs.T), shape=(len(cells),) * 2).tocsr()
    while (found := connected_components(graph, directed=False))[0] > 1:
        small = found[1] == np.bincount(found[1]).argmin()
        distance, nearest = map(np.asarray, KDTree(cells[~small]).query(cells[small]))
        a, b = np.flatnonzero(small)[distance.argmin()], np.flatnonzero(~small)[nearest[distance.argmin()]]
        graph = graph + scipy.sparse.coo_matrix(([distance.min()], ([a], [b])), shape=graph.shape).tocsr()
    return graph


def k_medoids(
    graph: scipy.sparse.csr_matrix,
    cells: Float[np.ndarray, "cell 3"],
    weight: Float[np.ndarray, "cell"],
    bones: int,
) -> Int[np.ndarray, "cell"]:
    """Return each voxel's bone: farthest-point seeds, then k-medoids by geodesic distance."""
    first = int(np.linalg.norm(cells - cells.mean(0), axis=1).argmin())
    seeds, distance = [], dijkstra(graph, directed=False, indices=first)
    for _ in range(bones):
        seeds.append(int(distance.argmax()))
        distance = np.minimum(distance, dijkstra(graph, directed=False, indices=seeds[-1]))
    label = np.zeros(len(cells), int)
    for _ in range(MEDOID_ITERATIONS):
        reach = dijkstra(graph, directed=False, indices=seeds)
        label = reach.argmin(0)
        for bone in range(bones):
            own = np.flatnonzero(label == bone)
            middle = np.average(cells[own], axis=0, weights=weight[own])
            seeds[bone] = int(own[np.linalg.norm(cells[own] - middle, axis=1).argmin()])
    return dijkstra(graph, directed=False, indices=seeds).argmin(0)
