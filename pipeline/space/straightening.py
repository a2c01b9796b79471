"""Take the drift out of a depth recording's odometry, or make odometry where there is none.

`straighten` aligns depth pictures of frames that see the same place (`depth_alignment`) and solves a `pose_graph` of
them with the phone's odometry; the loop of a walk around something closes by itself.
`chain` makes a first odometry from picture to picture.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.space import rigid, tears
from pipeline.space.align import rotation_between
from pipeline.space.depth_alignment import Alignment, DepthView, align_views
from pipeline.space.pose_graph import Edge, optimise


@dataclass(frozen=True)
class Straightening:
    """How much to trust odometry and depth."""

    key_every: int = 5
    """frames between keyframes"""
    loops: int = 3
    """earlier views a keyframe is aligned to, besides its predecessor"""
    reach_m: float = 0.15
    """largest distance of a surface from its counterpart"""
    odometry_rotation_rad: float = 0.002
    """drift of odometry from one frame to the next"""
    odometry_translation_m: float = 0.004
    """drift of odometry from one frame to the next"""
    torn: float = 60.0
    """times the drift by which a step may err where odometry is torn"""
    least_overlap: float = 0.4
    """share of the points that must meet"""
    alignment_iterations: int = 8
    graph_iterations: int = 8


@dataclass(frozen=True)
class Straightened:
    """Poses without drift and how well the depth pictures agree."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    edges: int
    """alignments that were accepted"""
    residual_m: float
    """median distance between aligned surfaces"""


def straighten(
    view: Callable[[int], DepthView],
    timestamp_s: Float[np.ndarray, "frame"],
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    options: Straightening,
) -> Straightened:
    """Refine odometry, mended where it is torn; the first camera keeps its pose, so that up stays up."""
    view = functools.lru_cache(maxsize=256)(view)
    count, torn = len(odometry_from_camera), tears.torn(timestamp_s, odometry_from_camera)
    odometry_from_camera, loose = tears.mended(timestamp_s, odometry_from_camera, torn), np.where(torn, options.torn, 1.0)[1:]
    sigma = np.r_[np.full(3, options.odometry_rotation_rad), np.full(3, options.odometry_translation_m)]
    relative = rigid.inverse(odometry_from_camera[:-1]) @ odometry_from_camera[1:]
    edges = [Edge(i, i + 1, relative[i], np.diag((loose[i] * sigma) ** -2), robust=False) for i in range(count - 1)]
    residuals = []
    for first, second in _pairs(odometry_from_camera, options):
        guess = rigid.inverse(odometry_from_camera[first]) @ odometry_from_camera[second]
        found = align_views(view(first), view(second), guess, reach_m=options.reach_m, iterations=options.alignment_iterations)
        if _credible(found, options):
            edges.append(Edge(first, second, found.target_from_source, found.information))
            residuals.append(found.residual_m)
    poses = optimise(odometry_from_camera, edges, iterations=options.graph_iterations)
    return Straightened(poses, len(residuals), float(np.median(residuals)) if residuals else float("nan"))


def chain(
    view: Callable[[int], DepthView],
    guess: Callable[[int, Float[np.ndarray, "4 4"]], Float[np.ndarray, "4 4"]],
    count: int,
    options: Straightening,
) -> Float[np.ndarray, "frame 4 4"]:
    """Make odometry by aligning each depth picture to the one before.

    ``guess(i, last)`` begins the search for frame i+1 in frame i's axes; ``last`` is the motion of the frame before.
    """
    poses, last = [np.eye(4)], np.eye(4)
    for index in range(count - 1):
        start = guess(index, last)
        found = align_views(view(index), view(index + 1), start, reach_m=options.reach_m, iterations=options.alignment_iterations)
        last = found.target_from_source if _credible(found, options) else start
        poses.append(poses[-1] @ last)
    return np.stack(poses)


def _credible(found: Alignment, options: Straightening) -> bool:
    return found.overlap > options.least_overlap and found.residual_m < 0.3 * options.reach_m


def _pairs(poses: Float[np.ndarray, "frame 4 4"], options: Straightening) -> list[tuple[int, int]]:
    """Choose keyframe pairs: each with its predecessor and with earlier ones that look at the same place from near by."""
    keys = np.arange(0, len(poses), options.key_every)
    centre, forward = poses[keys, :3, 3], poses[keys, :3, 2]
    pairs = []
    for b in range(1, len(keys)):
        pairs.append((int(keys[b - 1]), int(keys[b])))
        apart = np.linalg.norm(centre[: b - 1] - centre[b], axis=1) / 1.0
        apart += np.arccos(np.clip(forward[: b - 1] @ forward[b], -1, 1)) / 0.8
        for _ in range(options.loops):
            if not len(apart) or apart.min() > 1.2:
                break
            best = int(apart.argmin())
            pairs.append((int(keys[best]), int(keys[b])))
            apart[max(best - 2, 0) : best + 3] = np.inf
    return pairs


def level(
    view: Callable[[int], DepthView], world_from_camera: Float[np.ndarray, "frame 4 4"], pictures: int = 20
) -> Float[np.ndarray, "frame 4 4"]:
    """Turn a world of unknown gravity so that +y is up: the direction near the cameras' own up that most surfaces face."""
    up = -world_from_camera[:, :3, 1].mean(0)
    up /= np.linalg.norm(up)
    normals = []
    for frame in np.unique(np.linspace(0, len(world_from_camera) - 1, pictures).astype(int)):
        normal = view(frame).normals.reshape(-1, 3)
        normals.append(normal[np.abs(normal).sum(1) > 0] @ world_from_camera[frame, :3, :3].T)
    normals = np.concatenate(normals)
    for cosine in (0.75, 0.9, 0.97, 0.985, 0.985):
        facing = normals[normals @ up > cosine]
        if len(facing) < 100:
            break
        up = facing.mean(0) / np.linalg.norm(facing.mean(0))
    turn = rigid.make(rotation_between(up, np.array([0.0, 1.0, 0.0])), np.zeros(3))
    return turn @ world_from_camera
