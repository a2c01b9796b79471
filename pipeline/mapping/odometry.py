"""Correct the drift of a depth recording's odometry, or estimate odometry by ICP.

`find_jumps` detects tracking jumps and `repair` removes them. `correct_drift` aligns overlapping depth images
(`icp`) and solves a pose graph of them with the device's odometry; `chain_alignments` estimates odometry from
frame to frame; `align_gravity` turns +y up.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Bool, Float

from pipeline.geometry import rigid, subsampling
from pipeline.geometry.align import rotation_between
from pipeline.mapping.icp import DepthImage, IcpResult, align_views

JUMP_M_S = 4.0
"""A step is a jump if faster than its neighbors by more than this, m/s: hands reach about 2 m/s."""
SUSPECT_M_S = 0.8
"""Likewise, where depth decides: a hand can do it, and so can a jump of 10 cm."""
EXPLAINED_BETTER = 2.0
"""A suspect step is a jump if its mean square depth error is this many times that of the motion around it."""
JUMP_STRIDE_PX = 2
"""Grid spacing of the depth that decides."""
MEDIAN_WINDOW = 5
"""Window of the median filter of speeds, steps."""
MIN_STEP_S = 0.05
"""Lower bound of the time step when computing speeds, seconds."""
CAUCHY_SCALE = 3.0
"""Mahalanobis distance at which the weight of an edge of the pose graph is halved."""
FIXED_PRECISION, FREE_PRECISION = 1e12, 1e-6
"""Prior precision of the graph's first pose, which stays fixed, and of the others, for a regular Hessian."""
CONVERGED = 1e-6
"""Steps of the graph below this (radians, meters) end the iteration."""
KEYFRAME_STEP = 5
"""Frames between keyframes: half a second at 10 Hz, within which views overlap."""
LOOP_RADIUS_M, LOOP_RADIUS_RAD, LOOP_DISTANCE = 1.0, 0.8, 1.2
"""Loop candidates: distance / LOOP_RADIUS_M + angle / LOOP_RADIUS_RAD is at most LOOP_DISTANCE."""
LOOP_SPACING = 2
"""Non-maximum suppression: keyframes on either side of a loop partner that are skipped as redundant."""
REACH_M = 0.15
"""Correspondence distance of ICP, meters: several times the drift between loop partners."""
SIGMA_RAD, SIGMA_M = 0.002, 0.004
"""Odometry's standard deviation from one frame to the next, radians and meters (ARKit at 10 Hz)."""
JUMP_INFLATION = 60.0
"""Factor on the standard deviation of a step across a tracking jump."""
MIN_OVERLAP = 0.4
"""Least overlap of an accepted alignment."""
MAX_RESIDUAL = 0.3
"""Largest residual of an accepted alignment, share of `REACH_M`."""
ICP_ITERATIONS, GRAPH_ITERATIONS = 8, 8
"""Gauss-Newton steps, enough for convergence."""
CACHED_VIEWS = 256
"""Depth images kept in memory at once."""
UP_CONES = (0.75, 0.9, 0.97, 0.985, 0.985)
"""Cosines of the narrowing cones of surface normals that `align_gravity` averages."""
MIN_NORMALS = 100
"""Fewer normals in a cone end the search for up."""
GRAVITY_VIEWS = 20
"""Depth images whose normals estimate the up direction."""


@dataclass(frozen=True)
class CorrectedOdometry:
    """Drift-corrected poses, and how well the depth images agree."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    edges: int
    """Number of accepted alignments."""
    residual_m: float
    """Median ICP residual, meters; NaN without alignments."""


def correct_drift(
    view: Callable[[int], DepthImage],
    timestamp_s: Float[np.ndarray, "frame"],
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    *,
    loops: int = 3,
) -> CorrectedOdometry:
    """Refine odometry in its own frame after repairing tracking jumps; the first camera stays fixed.

    Each keyframe is aligned to its predecessor and to at most ``loops`` earlier loop candidates.
    """
    view = functools.lru_cache(maxsize=CACHED_VIEWS)(view)
    jumps = find_jumps(timestamp_s, odometry_from_camera, view)
    odometry_from_camera = repair(timestamp_s, odometry_from_camera, jumps)
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
        if is_reliable(result):
            edges.append(RelativePose(first, second, result.target_from_source, result.information))
            residuals.append(result.residual_m)
    poses = optimize_pose_graph(odometry_from_camera, edges, iterations=GRAPH_ITERATIONS)
    residual_m = float(np.median(residuals)) if residuals else float("nan")
    return CorrectedOdometry(poses, len(residuals), residual_m)


@dataclass(frozen=True)
class Guess:
    """The initial motion of an alignment."""

    first_from_second: Float[np.ndarray, "4 4"]
    agrees: Callable[[Float[np.ndarray, "4 4"]], bool] = lambda motion: True
    """Whether an aligned motion agrees with what the guess was made of."""


def chain_alignments(
    view: Callable[[int], DepthImage], guess: Callable[[int, Float[np.ndarray, "4 4"]], Guess], count: int
) -> Float[np.ndarray, "frame 4 4"]:
    """Estimate odometry of ``count`` frames by aligning each depth image to its predecessor.

    ``guess(i, last)`` is the initial pose of frame i+1 in frame i; ``last`` is the previous motion. Where the
    alignment is unreliable or does not agree with it, the guess is kept.
    """
    steps, last = [], np.eye(4)
    for index in range(count - 1):
        start = guess(index, last)
        motion, views = start.first_from_second, (view(index), view(index + 1))
        result = align_views(*views, motion, reach_m=REACH_M, iterations=ICP_ITERATIONS)
        accepted = is_reliable(result) and start.agrees(result.target_from_source)
        last = result.target_from_source if accepted else motion
        steps.append(last)
    return rigid.accumulate(np.array(steps).reshape(-1, 4, 4))


def is_reliable(result: IcpResult) -> bool:
    """Return whether enough of two views overlaps, and agrees."""
    return result.overlap > MIN_OVERLAP and result.residual_m < MAX_RESIDUAL * REACH_M


def _keyframe_pairs(poses: Float[np.ndarray, "frame 4 4"], loops: int) -> list[tuple[int, int]]:
    """Pair each keyframe with its predecessor and its nearest loop candidates."""
    keys = np.arange(0, len(poses), KEYFRAME_STEP)
    center, forward = poses[keys, :3, 3], poses[keys, :3, 2]
    pairs = []
    for key in range(1, len(keys)):
        pairs.append((int(keys[key - 1]), int(keys[key])))
        separation = np.linalg.norm(center[: key - 1] - center[key], axis=1) / LOOP_RADIUS_M
        separation += np.arccos(np.clip(forward[: key - 1] @ forward[key], -1, 1)) / LOOP_RADIUS_RAD
        for _ in range(loops):
            if not len(separation) or separation.min() > LOOP_DISTANCE:
                break
            best = int(separation.argmin())
            pairs.append((int(keys[best]), int(keys[key])))
            separation[max(best - LOOP_SPACING, 0) : best + LOOP_SPACING + 1] = np.inf
    return pairs


def align_gravity(
    view: Callable[[int], DepthImage], world_from_camera: Float[np.ndarray, "frame 4 4"]
) -> Float[np.ndarray, "frame 4 4"]:
    """Rotate the world so that +y is up, the dominant surface normal near the cameras' mean up direction."""
    up = -world_from_camera[:, :3, 1].mean(0)
    up /= np.linalg.norm(up)
    normals = []
    for frame in subsampling.evenly(len(world_from_camera), GRAVITY_VIEWS):
        normal = view(int(frame)).normals.reshape(-1, 3)
        normals.append(normal[np.abs(normal).sum(1) > 0] @ world_from_camera[frame, :3, :3].T)
    normals = np.concatenate(normals)
    for cosine in UP_CONES:
        facing = normals[normals @ up > cosine]
        if len(facing) < MIN_NORMALS:
            break
        up = facing.mean(0) / np.linalg.norm(facing.mean(0))
    return rigid.make(rotation_between(up, np.array([0.0, 1.0, 0.0])), np.zeros(3)) @ world_from_camera


@dataclass(frozen=True)
class RelativePose:
    """A measured motion between two frames, with the information matrix of its twist in the first frame."""

    first: int
    second: int
    first_from_second: Float[np.ndarray, "4 4"]
    information: Float[np.ndarray, "6 6"]
    robust: bool = True
    """Whether the measurement may be an outlier (Cauchy's weight)."""


def optimize_pose_graph(
    world_from_camera: Float[np.ndarray, "frame 4 4"], edges: Sequence[RelativePose], *, iterations: int
) -> Float[np.ndarray, "frame 4 4"]:
    """Minimize the edges' squared Mahalanobis errors by Gauss-Newton; the first pose is fixed.

    An edge's residual is log(current first_from_second @ measured second_from_first), its robust kernel
    Cauchy's. Jacobians assume small residuals, which holds for odometry.
    """
    poses = np.array(world_from_camera, float)
    first = np.array([edge.first for edge in edges])
    second = np.array([edge.second for edge in edges])
    measured = np.stack([edge.first_from_second for edge in edges])
    information = np.stack([edge.information for edge in edges])
    robust = np.array([edge.robust for edge in edges])
    for _ in range(iterations):
        relative = rigid.inverse(poses[first]) @ poses[second]
        residual = rigid.log(relative @ rigid.inverse(measured))
        square = np.einsum("ei,eij,ej->e", residual, information, residual)
        weighted = information * np.where(robust, 1 / (1 + square / CAUCHY_SCALE**2), 1.0)[:, None, None]
        step = _solve(len(poses), first, second, relative, residual, weighted)
        poses = poses @ rigid.exp(step)
        if np.abs(step).max() < CONVERGED:
            break
    return poses


def _solve(count, first, second, relative, residual, information) -> Float[np.ndarray, "frame 6"]:
    """Solve one Gauss-Newton step for the poses' right-hand twists."""
    rotation, translation = relative[:, :3, :3], relative[:, :3, 3]
    j_first = -np.broadcast_to(np.eye(6), information.shape)
    # The adjoint maps the second camera's twist to the first camera's frame.
    j_second = np.zeros_like(information)
    j_second[:, :3, :3] = j_second[:, 3:, 3:] = rotation
    j_second[:, 3:, :3] = np.cross(translation[:, None, :], rotation.transpose(0, 2, 1)).transpose(0, 2, 1)
    entries, gradient, inner = [], np.zeros((count, 6)), np.arange(6)
    for index_a, j_a in ((first, j_first), (second, j_second)):
        weighted = j_a.transpose(0, 2, 1) @ information
        np.add.at(gradient, index_a, np.einsum("eij,ej->ei", weighted, residual))
        for index_b, j_b in ((first, j_first), (second, j_second)):
            rows, columns = 6 * index_a[:, None, None] + inner[:, None], 6 * index_b[:, None, None] + inner
            entries.append(np.broadcast_arrays(weighted @ j_b, rows, columns))
    blocks, rows, columns = (np.concatenate(part).ravel() for part in zip(*entries, strict=True))
    hessian = scipy.sparse.coo_matrix((blocks, (rows, columns)), shape=(6 * count, 6 * count))
    prior = scipy.sparse.diags(np.r_[np.full(6, FIXED_PRECISION), np.full(6 * (count - 1), FREE_PRECISION)])
    return -scipy.sparse.linalg.spsolve((hessian + prior).tocsc(), gradient.reshape(-1)).reshape(count, 6)


def find_jumps(
    timestamp_s: Float[np.ndarray, "frame"],
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    view: Callable[[int], DepthImage] | None = None,
) -> Bool[np.ndarray, "frame"]:
    """Return which frames follow a tracking jump; False for the first.

    Only fast translation is suspect: a phone can really turn as fast as a jump does. With ``view``, depth
    decides on steps that a hand could do: a jump is refuted by it, and the motion around the step is not.
    """
    if len(timestamp_s) < 2:
        return np.zeros(len(timestamp_s), bool)
    step_m = np.linalg.norm(np.diff(odometry_from_camera[:, :3, 3], axis=0), axis=1)
    speed = step_m / np.maximum(np.diff(timestamp_s), MIN_STEP_S)
    excess = np.r_[0.0, speed - scipy.ndimage.median_filter(speed, MEDIAN_WINDOW, mode="mirror")]
    jumps = excess > JUMP_M_S
    if view is None or len(timestamp_s) < MEDIAN_WINDOW:
        return jumps
    for frame in np.flatnonzero((excess > SUSPECT_M_S) & ~jumps).tolist():
        suspect = jumps.copy()
        suspect[frame] = True
        repaired = repair(timestamp_s, odometry_from_camera, suspect)
        error, otherwise = (_depth_error(view, frame, poses) for poses in (odometry_from_camera, repaired))
        jumps[frame] = error > EXPLAINED_BETTER * otherwise
    return jumps


def _depth_error(
    view: Callable[[int], DepthImage], frame: int, poses: Float[np.ndarray, "frame 4 4"]
) -> float:
    """Return the mean square depth difference of a frame and its predecessor, at most `REACH_M` squared."""
    step = rigid.inverse(poses[frame - 1]) @ poses[frame]
    found = align_views(view(frame - 1), view(frame), step, reach_m=REACH_M, iterations=1)
    return found.overlap * found.residual_m**2 + (1 - found.overlap) * REACH_M**2


def repair(
    timestamp_s: Float[np.ndarray, "frame"],
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    jumps: Bool[np.ndarray, "frame"],
) -> Float[np.ndarray, "frame 4 4"]:
    """Replace each jump by the interpolated velocity around it; without jumps return the input."""
    if not jumps.any():
        return odometry_from_camera
    step = rigid.inverse(odometry_from_camera[:-1]) @ odometry_from_camera[1:]
    gap_s = np.diff(timestamp_s)[:, None]
    broken, intact = np.flatnonzero(jumps[1:]), np.flatnonzero(~jumps[1:])
    rate = rigid.log(step[intact]) / np.maximum(gap_s[intact], MIN_STEP_S)
    step[broken] = rigid.exp(
        gap_s[broken] * np.stack([np.interp(broken, intact, axis) for axis in rate.T], axis=1)
    )
    return rigid.accumulate(step, odometry_from_camera[0])
