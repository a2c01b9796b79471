"""RGB-D visual odometry: optical flow matches pixels, depth lifts them, RANSAC and IRLS fit the motion.

`prepare_frame` resizes and back-projects a frame, `relative_motion` estimates the motion between two,
`chain_motions` processes a recording without odometry of its own.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.geometry import align, cameras, rigid
from pipeline.mapping import pose_optimization, sift
from pipeline.mapping.odometry import JUMP_INFLATION

HEIGHT_PX = 240
"""Shorter side of the pictures for optical flow, pixels: DIS is fast there and still sub-pixel."""
STRIDE_PX = 7
"""Grid spacing of the matched pixels."""
INLIER_M = 0.03
"""Inlier threshold, meters at 2 m depth; proportional to depth, as the noise is."""
INLIER_DEPTH_M, MIN_SCALE = 2.0, 0.5
"""Depth at which `INLIER_M` holds, meters, and the least scale of it for nearer points."""
RANSAC_TRIPLETS = 100
REFINE_ROUNDS = 5
"""Iterations of reweighted least squares after RANSAC, enough for convergence."""
MIN_PAIRS = 20
"""Least number of matches with depth."""
MIN_DEPTH_M = 0.1
"""Smaller depth counts as missing, meters."""
MIN_INLIER_RATIO = 0.35
"""Below this inlier ratio the motion is unknown (a tracking jump)."""
GOOD_INLIER_RATIO = 0.7
"""From this inlier ratio on no other initial guess is tried."""
SIGMA_RAD, SIGMA_M = float(np.deg2rad(0.25)), 0.008
"""Standard deviations of one motion, radians and meters, measured on rendered sessions."""
SIFT_FEATURES = 500
"""SIFT keypoints per picture, for the fallback where flow fails."""
FAR_M = 1e3
"""Depth substituted for unknown depth when warping, meters."""
CLAHE_CLIP, CLAHE_TILES = 4.0, (6, 8)
"""CLAHE before optical flow: clip limit and tiles (columns, rows)."""


@dataclass(frozen=True)
class FlowFrame:
    """A frame prepared for motion estimation."""

    gray: UInt8[np.ndarray, "height width"]
    points_camera: Float[np.ndarray, "height width 3"]
    """Back-projected pixels, meters; z = 0 where depth is unknown or masked."""
    intrinsics: Float[np.ndarray, "3 3"]
    """Of the resized picture, pixels."""


@dataclass(frozen=True)
class Odometry:
    """Odometry of a recording, by its device or from its pictures."""

    odometry_from_camera: Float[np.ndarray, "frame 4 4"]
    jumps: Bool[np.ndarray, "frame"]
    """The motion from the frame before is unknown; False for the first."""
    relative_poses: pose_optimization.RelativePoseFactors


def prepare_frame(
    color: UInt8[np.ndarray, "height width 3"],
    depth: Float[np.ndarray, "depth_height depth_width"],
    intrinsics: Float[np.ndarray, "3 3"],
    depth_intrinsics: Float[np.ndarray, "3 3"],
    usable: Bool[np.ndarray, "height width"],
) -> FlowFrame:
    """Resize a frame for optical flow and back-project usable pixels; color and depth share a center."""
    scale = min(1.0, HEIGHT_PX / min(color.shape[:2]))
    size = (round(color.shape[0] * scale), round(color.shape[1] * scale))
    gray = cv2.resize(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), size[::-1], interpolation=cv2.INTER_AREA)
    scaled = cameras.scale_intrinsics(intrinsics, color.shape[:2], size)
    points = cameras.back_project_pixels(cameras.pixel_grid(*size), scaled, depth, depth_intrinsics)
    keep = cv2.resize(usable.astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST) > 0
    return FlowFrame(gray, points * keep[..., None], scaled)


def relative_motion(
    first: FlowFrame,
    second: FlowFrame,
    rng: np.random.Generator,
    last_motion: Float[np.ndarray, "4 4"] | None = None,
) -> tuple[Float[np.ndarray, "4 4"], float]:
    """Return ``first_from_second`` and its inlier ratio; the identity and 0 with too few matches.

    Flow is initialized by the last motion, since phones move steadily and floors repeat. If that yields few
    inliers, no motion and matched SIFT keypoints, which survive large turns, are tried; the best wins.
    """
    best = _motion_from_guess(first, second, np.eye(4) if last_motion is None else last_motion, rng)
    guesses: list[Callable[[], np.ndarray]] = [] if last_motion is None else [lambda: np.eye(4)]
    for guess in [*guesses, lambda: _motion_from_sift(first, second, rng)]:
        if best[1] >= GOOD_INLIER_RATIO:
            break
        best = max(best, _motion_from_guess(first, second, guess(), rng), key=lambda each: each[1])
    return best


def _motion_from_guess(first, second, guess, rng):
    """Estimate the motion by flow to the second picture, warped to the first's view by the guess."""
    height, width = first.gray.shape
    start = STRIDE_PX // 2
    row, column = np.mgrid[start:height:STRIDE_PX, start:width:STRIDE_PX].reshape(2, -1)
    end = _flow_targets(first, second, guess, row, column)
    inside = ((end >= 0) & (end < (width, height))).all(1)
    source = second.points_camera[end[inside, 1], end[inside, 0]]
    target = first.points_camera[row[inside], column[inside]]
    valid = (source[:, 2] > MIN_DEPTH_M) & (target[:, 2] > MIN_DEPTH_M)
    source, target = source[valid], target[valid]
    if len(source) < MIN_PAIRS:
        return np.eye(4), 0.0
    scale = np.maximum(target[:, 2] / INLIER_DEPTH_M, MIN_SCALE)
    first_from_second, _ = align.ransac_rigid(
        source, target, threshold_m=INLIER_M, iterations=RANSAC_TRIPLETS, rng=rng, weights=1 / scale
    )

    def residual() -> np.ndarray:
        return np.linalg.norm(rigid.apply(first_from_second, source) - target, axis=1) / scale

    for _ in range(REFINE_ROUNDS):
        weight = (INLIER_M**2 / (INLIER_M**2 + residual() ** 2)) ** 2 / scale**2
        first_from_second = align.kabsch(source, target, weight)
    return first_from_second, float((residual() < INLIER_M).mean())


def _flow_targets(first, second, guess, row, column):
    """Return the pixels (column, row) of the second picture that flow matches to pixels of the first."""
    z = first.points_camera[..., 2:]
    far = FAR_M * cameras.ray_directions(first.intrinsics, *first.gray.shape)
    moved = rigid.apply(rigid.inverse(guess), np.where(z > 0, first.points_camera, far))
    projected = cameras.project(moved, second.intrinsics)[0].astype(np.float32)
    warped = cameras.sample_bilinear(second.gray, projected)
    clahe = cv2.createCLAHE(CLAHE_CLIP, CLAHE_TILES)
    start = np.zeros((*first.gray.shape, 2), np.float32)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(
        clahe.apply(first.gray), clahe.apply(warped), start
    )
    x, y = (np.stack([column, row], axis=1) + flow[row, column]).astype(np.float32).T[:, None]
    return np.floor(cv2.remap(projected, x, y, cv2.INTER_LINEAR, borderValue=(-1, -1))[0]).astype(int)


def _motion_from_sift(first, second, rng):
    """Return the motion by RANSAC over matched SIFT keypoints."""

    def points(frame: FlowFrame) -> sift.SiftPoints:
        intrinsics, depth = frame.intrinsics, frame.points_camera[..., 2]
        return sift.lift(sift.describe(frame.gray, SIFT_FEATURES), intrinsics, depth, intrinsics)

    first, second = points(first), points(second)
    pairs = sift.matches(first.descriptors, second.descriptors)
    source, target = second.points_camera[pairs[:, 1]], first.points_camera[pairs[:, 0]]
    return align.ransac_rigid(source, target, threshold_m=INLIER_M, iterations=RANSAC_TRIPLETS, rng=rng)[0]


def chain_motions(frames: Iterable[FlowFrame], rng: np.random.Generator) -> Odometry:
    """Chain the motions between consecutive frames; an unknown motion is a jump and replaced by identity."""
    steps, jumps, previous = [], [False], None
    for frame in frames:
        if previous is not None:
            last_motion = None if jumps[-1] or not steps else steps[-1]
            step, inlier_ratio = relative_motion(previous, frame, rng, last_motion)
            jumps.append(inlier_ratio < MIN_INLIER_RATIO)
            steps.append(np.eye(4) if jumps[-1] else step)
        previous = frame
    inflation = np.where(jumps[1:], JUMP_INFLATION, 1.0)
    motions, first = np.array(steps).reshape(-1, 4, 4), np.arange(len(steps))
    factors = pose_optimization.RelativePoseFactors(
        first, first + 1, motions, SIGMA_RAD * inflation, SIGMA_M * inflation
    )
    return Odometry(rigid.accumulate(motions), np.array(jumps), factors)
