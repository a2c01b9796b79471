"""Motion from one picture with depth to the next: optical flow pairs pixels, depth lifts them, a robust closed form answers.

`look` prepares a frame, `motion` compares two, `follow` chains a whole recording where the phone gave no odometry.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.space import align, cameras, relax, rigid, sift_points


@dataclass(frozen=True)
class FollowOptions:
    """How pairs are compared and how far they are trusted."""

    height_px: int = 240
    """Pictures are brought to this size of their shorter side before flow, pixels."""
    stride_px: int = 7
    """One pixel in so many, each way, takes part."""
    threshold_m: float = 0.03
    """Pairs of points within this agree, metres at 2 m; it grows with depth."""
    iterations: int = 100
    """RANSAC triplets."""
    least_share: float = 0.35
    """Share of the pairs that must agree; below, the chain is torn here."""
    enough_share: float = 0.7
    """With this share no other explanation is looked for."""
    sigma_deg: float = 0.25
    """Standard deviation of one motion, degrees."""
    sigma_m: float = 0.008
    """Standard deviation of one motion, metres."""
    torn: float = 60.0
    """A torn motion's deviations are so many times larger."""


@dataclass(frozen=True)
class Look:
    """A frame, ready to be compared."""

    gray: UInt8[np.ndarray, "height width"]
    points_camera: Float[np.ndarray, "height width 3"]
    """Per pixel of the picture; z = 0 where depth is unknown or not to be used."""
    intrinsics: Float[np.ndarray, "3 3"]
    """Of the picture at this size."""


@dataclass(frozen=True)
class Followed:
    """A recording's own odometry, made from its pictures or told by the phone."""

    odometry_from_camera: Float[np.ndarray, "frame 4 4"]
    torn: Bool[np.ndarray, "frame"]
    """The motion from the frame before is not known; False for the first."""
    relatives: relax.Relatives


def look(
    color: UInt8[np.ndarray, "height width 3"],
    depth: Float[np.ndarray, "depth_height depth_width"],
    intrinsics: Float[np.ndarray, "3 3"],
    depth_intrinsics: Float[np.ndarray, "3 3"],
    usable: Bool[np.ndarray, "height width"],
    options: FollowOptions,
) -> Look:
    """Bring a frame to the size at which flow is computed and lift its usable pixels; colour and depth share a camera."""
    scale = min(1.0, options.height_px / min(color.shape[:2]))
    size = (round(color.shape[0] * scale), round(color.shape[1] * scale))
    gray = cv2.resize(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), size[::-1], interpolation=cv2.INTER_AREA)
    scaled = cameras.scale_intrinsics(intrinsics, color.shape[:2], size)
    rays = cameras.ray_directions(scaled, *size)
    pixel, _ = cameras.project(rays, depth_intrinsics)
    column, row = np.moveaxis(np.floor(pixel).astype(int), -1, 0)
    inside = (row >= 0) & (column >= 0) & (row < depth.shape[0]) & (column < depth.shape[1])
    z = np.where(inside, depth[np.clip(row, 0, depth.shape[0] - 1), np.clip(column, 0, depth.shape[1] - 1)], 0)
    keep = cv2.resize(usable.astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST) > 0
    return Look(gray, rays * np.where(keep, z, 0)[..., None], scaled)


def motion(
    first: Look, second: Look, options: FollowOptions, rng: np.random.Generator, before: Float[np.ndarray, "4 4"] | None = None
) -> tuple[Float[np.ndarray, "4 4"], float]:
    """Return ``first_from_second`` and the share of the pairs that agree with it; the identity and 0 without pairs.

    Flow begins at the motion ``before`` this one, since phones move steadily and floors repeat; where that explains little,
    at no motion, and at the motion that SIFT points tell, which large turns do not disturb. The best explanation is taken.
    """
    found = _from_guess(first, second, np.eye(4) if before is None else before, options, rng)
    guesses = [] if before is None else [lambda: np.eye(4)]
    for guess in [*guesses, lambda: _from_points(first, second, options, rng)]:
        if found[1] >= options.enough_share:
            break
        found = max(found, _from_guess(first, second, guess(), options, rng), key=lambda each: each[1])
    return found


def _from_guess(first, second, guess, options, rng):
    """Compare the first picture with the second as seen from the first's place under the guessed motion."""
    height, width = first.gray.shape
    there = _pixels_in_second(first, second, guess)
    moved = cv2.remap(second.gray, there[..., 0] - 0.5, there[..., 1] - 0.5, cv2.INTER_LINEAR)
    even = cv2.createCLAHE(4.0, (6, 8))
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(even.apply(first.gray), even.apply(moved), None)
    step = options.stride_px
    row, column = np.mgrid[step // 2 : height : step, step // 2 : width : step].reshape(2, -1)
    end = (np.stack([column, row], axis=1) + flow[row, column]).astype(np.float32)
    end = np.floor(cv2.remap(there, end[None], None, cv2.INTER_LINEAR, borderValue=(-1, -1))[0]).astype(int)
    inside = ((end >= 0) & (end < (width, height))).all(1)
    source = second.points_camera[end[inside, 1], end[inside, 0]]
    target = first.points_camera[row[inside], column[inside]]
    known = (source[:, 2] > 0.1) & (target[:, 2] > 0.1)
    source, target = source[known], target[known]
    if len(source) < 20:
        return np.eye(4), 0.0
    far = np.maximum(target[:, 2] / 2, 0.5)
    first_from_second, _ = align.ransac_rigid(
        source, target, threshold_m=options.threshold_m, iterations=options.iterations, rng=rng, weights=1 / far
    )
    for _ in range(5):
        gap = np.linalg.norm(rigid.apply(first_from_second, source) - target, axis=1) / far
        weight = (options.threshold_m**2 / (options.threshold_m**2 + gap**2)) ** 2 / far**2
        first_from_second = align.kabsch(source, target, weight)
    gap = np.linalg.norm(rigid.apply(first_from_second, source) - target, axis=1) / far
    return first_from_second, float((gap < options.threshold_m).mean())


def _pixels_in_second(first, second, guess):
    """Return where each pixel of the first lies in the second under the guessed ``first_from_second``; far where no depth is."""
    z = first.points_camera[..., 2:]
    points = np.where(z > 0, first.points_camera, 1e3 * cameras.ray_directions(first.intrinsics, *first.gray.shape))
    return cameras.project(rigid.apply(rigid.inverse(guess), points), second.intrinsics)[0].astype(np.float32)


def _from_points(first, second, options, rng):
    """Return the motion that matched SIFT points tell."""
    points = [
        sift_points.sift_points(each.gray, each.intrinsics, each.points_camera[..., 2], each.intrinsics, 500) for each in (first, second)
    ]
    pairs = sift_points.matches(*points)
    source, target = points[1].points_camera[pairs[:, 1]], points[0].points_camera[pairs[:, 0]]
    return align.ransac_rigid(source, target, threshold_m=options.threshold_m, iterations=options.iterations, rng=rng)[0]


def follow(views: Iterable[Look], options: FollowOptions, rng: np.random.Generator) -> Followed:
    """Chain the motions between neighbouring frames; where pictures do not tell, the chain is torn and nothing moves."""
    steps, torn, before = [], [False], None
    for view in views:
        if before is not None:
            step, share = motion(before, view, options, rng, None if torn[-1] or not steps else steps[-1])
            torn.append(share < options.least_share)
            steps.append(np.eye(4) if torn[-1] else step)
        before = view
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step)
    looseness = np.where(torn[1:], options.torn, 1.0)
    sigma_rad, sigma_m = np.deg2rad(options.sigma_deg) * looseness, options.sigma_m * looseness
    first = np.arange(len(steps))
    edges = relax.Relatives(first, first + 1, np.array(steps).reshape(-1, 4, 4), sigma_rad, sigma_m)
    return Followed(np.stack(poses), np.array(torn), edges)
