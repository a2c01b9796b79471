"""Correct the drift of a depth recording's odometry, or make odometry where there is none.

`correct_drift` aligns depth images of frames that see the same place (`icp`) and solves a pose graph of them
with the device's odometry; `chain_alignments` makes a first odometry from frame to frame; `align_gravity`
turns +y up.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry import rigid, subsampling
from pipeline.geometry.align import rotation_between
from pipeline.mapping import tracking_jumps
from pipeline.mapping.icp import DepthImage, IcpResult, align_views
from pipeline.mapping.pose_graph import RelativePose, optimize_pose_graph

KEYFRAME_STEP = 5
"""Frames between keyframes: half a second at 10 Hz, within which views overlap."""
LOOP_RADIUS_M, LOOP_RADIUS_RAD, LOOP_DISTANCE = 1.0, 0.8, 1.2
"""Keyframes see the same place when distance / metres + angle / radians of these is below the last."""
LOOP_SPACING = 2
"""Keyframes on either side of a chosen loop partner that are not chosen too: they would repeat it."""
REACH_M = 0.15
"""Largest distance of a surface from its counterpart, metres: several times the drift between loop
partners."""
SIGMA_RAD, SIGMA_M = 0.002, 0.004
"""Odometry's standard deviation from one frame to the next, radians and metres (ARKit at 10 Hz)."""
JUMP_INFLATION = 60.0
"""A step over a tracking jump may err by so many times the usual deviation."""
LEAST_OVERLAP = 0.4
"""Share of the points that must meet for an alignment to count."""
LARGEST_RESIDUAL = 0.3
"""Residual beyond which an alignment does not count, share of `REACH_M`."""
ICP_ITERATIONS, GRAPH_ITERATIONS = 8, 8
"""Gauss-Newton steps; both have converged by then."""
CACHED_VIEWS = 256
"""Depth images kept in memory at once."""
UP_CONES = (0.75, 0.9, 0.97, 0.985, 0.985)
"""Cosines of the narrowing cones of surface normals that `align_gravity` averages."""
LEAST_NORMALS = 100
"""Fewer normals in a cone end the search for up."""
GRAVITY_VIEWS = 20
"""Depth images that vote on up."""


@dataclass(frozen=True)
class CorrectedOdometry:
    """Poses without drift, and how well the depth images agree."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    edges: int
    """Alignments that were accepted."""
    residual_m: float
    """Median distance between aligned surfaces, metres; NaN without alignments."""


def correct_drift(
    view: Callable[[int], DepthImage],
    timestamp_s: Float[np.ndarray, "frame"],
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    *,
    loops: int = 3,
) -> CorrectedOdometry:
    """Refine odometry, repaired at tracking jumps, in its own frame; the first camera keeps its pose, so up
    stays up.

    Each keyframe is aligned to its predecessor and to ``loops`` earlier ones that see the same place.
    """
    view = functools.lru_cache(maxsize=CACHED_VIEWS)(view)
    jumps = tracking_jumps.find_jumps(timestamp_s, odometry_from_camera)
    odometry_from_camera = tracking_jumps.repair(timestamp_s, odometry_from_camera, jumps)
    inflation = np.where(jumps, JUMP_INFLATION, 1.0)[1:]
    sigma = np.repeat([SIGMA_RAD, SIGMA_M], 3)
    relative = rigid.inverse(odometry_from_camera[:-1]) @ odometry_from_camera[1:]
    edges = [
        RelativePose(first, first + 1, step, np.diag((factor * sigma) ** -2), robust=False)
        for first, (step, factor) in enumerate(zip(relative, inflation, strict=True))
    ]
    residuals = []
    for first, second in _keyframe_pairs(odometry_from_camera, loops):
        guess = rigid.inverse(odometry_from_camera[first]) @ odometry_from_camera[second]
        result = align_views(view(first), view(second), guess, reach_m=REACH_M, iterations=ICP_ITERATIONS)
        if _credible(result):
            edges.append(RelativePose(first, second, result.target_from_source, result.information))
            residuals.append(result.residual_m)
    poses = optimize_pose_graph(odometry_from_camera, edges, iterations=GRAPH_ITERATIONS)
    return CorrectedOdometry(
        poses, len(residuals), float(np.median(residuals)) if residuals else float("nan")
    )


def chain_alignments(
    view: Callable[[int], DepthImage],
    guess: Callable[[int, Float[np.ndarray, "4 4"]], Float[np.ndarray, "4 4"]],
    count: int,
) -> Float[np.ndarray, "frame 4 4"]:
    """Make odometry of ``count`` frames by aligning each depth image to the one before; the first is the
    origin.

    ``guess(i, last)`` starts the alignment of frame i+1 in frame i's axes; ``last`` is the motion before it.
    """
    steps, last = [], np.eye(4)
    for index in range(count - 1):
        start = guess(index, last)
        result = align_views(view(index), view(index + 1), start, reach_m=REACH_M, iterations=ICP_ITERATIONS)
        last = result.target_from_source if _credible(result) else start
        steps.append(last)
    return rigid.accumulate(np.array(steps).reshape(-1, 4, 4))


def _credible(result: IcpResult) -> bool:
    return result.overlap > LEAST_OVERLAP and result.residual_m < LARGEST_RESIDUAL * REACH_M


def _keyframe_pairs(poses: Float[np.ndarray, "frame 4 4"], loops: int) -> list[tuple[int, int]]:
    """Pair each keyframe with its predecessor and with earlier ones that see the same place from near by."""
    keys = np.arange(0, len(poses), KEYFRAME_STEP)
    centre, forward = poses[keys, :3, 3], poses[keys, :3, 2]
    pairs = []
    for key in range(1, len(keys)):
        pairs.append((int(keys[key - 1]), int(keys[key])))
        apart = np.linalg.norm(centre[: key - 1] - centre[key], axis=1) / LOOP_RADIUS_M
        apart += np.arccos(np.clip(forward[: key - 1] @ forward[key], -1, 1)) / LOOP_RADIUS_RAD
        for _ in range(loops):
            if not len(apart) or apart.min() > LOOP_DISTANCE:
                break
            best = int(apart.argmin())
            pairs.append((int(keys[best]), int(keys[key])))
            apart[max(best - LOOP_SPACING, 0) : best + LOOP_SPACING + 1] = np.inf
    return pairs


def align_gravity(
    view: Callable[[int], DepthImage], world_from_camera: Float[np.ndarray, "frame 4 4"]
) -> Float[np.ndarray, "frame 4 4"]:
    """Turn a world of unknown gravity so that +y is up: the direction near the cameras' own up that most
    normals have."""
    up = -world_from_camera[:, :3, 1].mean(0)
    up /= np.linalg.norm(up)
    normals = []
    for frame in subsampling.evenly(len(world_from_camera), GRAVITY_VIEWS):
        normal = view(int(frame)).normals.reshape(-1, 3)
        normals.append(normal[np.abs(normal).sum(1) > 0] @ world_from_camera[frame, :3, :3].T)
    normals = np.concatenate(normals)
    for cosine in UP_CONES:
        facing = normals[normals @ up > cosine]
        if len(facing) < LEAST_NORMALS:
            break
        up = facing.mean(0) / np.linalg.norm(facing.mean(0))
    return rigid.make(rotation_between(up, np.array([0.0, 1.0, 0.0])), np.zeros(3)) @ world_from_camera
