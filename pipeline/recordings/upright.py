"""Quarter turns that make a recording upright: from gravity, else from camera poses and the room."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pipeline.geometry import cameras
from pipeline.geometry.ground import floor_direction
from pipeline.mapping import depth_scans

ROLL = 4.0
"""weight of the mean squared sine of camera roll, relative to the share of level surface"""
MARGIN = 0.15
"""minimum lead of the best of four directions over the second best"""
NEAR_GUESS_DEG = 35.0
"""search angle for up around the mean up direction of the cameras: phones are held tilted"""
LEVEL_COSINE = 0.95
"""surfaces within 18 degrees of level are floor (facing up) or ceiling"""
SIDE_PX = 200
"""longer side to which depth is subsampled for normals, which are too noisy at full resolution"""
MIN_POINTS = 100
"""minimum number of points with a normal"""


def quarter_turns_from_gravity(
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    *,
    up_odometry: tuple[float, float, float] | Float[np.ndarray, "3"] = (0.0, 1.0, 0.0),
) -> int:
    """Return the clockwise quarter turns (0..3) after which world up points up in the pictures, on average.

    It is 0 unless another turn is better by 0.1 (mean cosine): a phone may look down.
    """
    up_in_picture = [
        -(cameras.turn_camera(odometry_from_camera, turns)[:, :3, 1] @ np.asarray(up_odometry)).mean()
        for turns in range(4)
    ]
    best = int(np.argmax(up_in_picture))
    return best if up_in_picture[best] > up_in_picture[0] + 0.1 else 0


def up_from_room(
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    views: Sequence[tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "3 3"]]],
) -> Float[np.ndarray, "3"] | None:
    """Return the up direction if no sensor measured it, or None if it is ambiguous.

    Each of the four sides of the pictures is a hypothesis, refined by the room's planes (Manhattan world).
    The score rewards level surface seen from above (floor, seats) rather than below, and cameras without
    roll. ``views`` are (depth in meters, intrinsics) of frames spread evenly.
    """
    seen = np.linspace(0, len(odometry_from_camera) - 1, len(views)).round().astype(int)
    normals = [
        _normals(*view) @ odometry[:3, :3].T
        for view, odometry in zip(views, odometry_from_camera[seen], strict=True)
    ]
    towards_camera = np.concatenate(normals)
    if len(towards_camera) < MIN_POINTS:
        return None
    directions, scores = [], []
    for turns in range(4):
        turned = cameras.turn_camera(odometry_from_camera, turns)
        guess = -turned[:, :3, 1].mean(0)
        up = floor_direction(towards_camera, guess / np.linalg.norm(guess), within_deg=NEAR_GUESS_DEG)
        facing = towards_camera @ up
        roll = float(((turned[:, :3, 0] @ up) ** 2).mean())
        directions.append(up)
        scores.append(float((facing > LEVEL_COSINE).mean() - (facing < -LEVEL_COSINE).mean()) - ROLL * roll)
    best, second = np.argsort(scores)[::-1][:2]
    return directions[best] if scores[best] > scores[second] + MARGIN else None


def _normals(
    depth: Float[np.ndarray, "height width"], intrinsics: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "point 3"]:
    """Return a subsample of surface normals, in camera axes."""
    step = max(1, max(depth.shape) // SIDE_PX)
    thinned = depth[step // 2 :: step, step // 2 :: step]
    normal = depth_scans.image_normals(
        thinned, cameras.scale_intrinsics(intrinsics, depth.shape, thinned.shape)
    )
    return normal[np.abs(normal).sum(-1) > 0][::5]


def quarter_turns_from_room(
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    views: Sequence[tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "3 3"]]],
) -> int:
    """Return the clockwise quarter turns (0..3) to upright if no sensor measured up, 0 if ambiguous."""
    up = up_from_room(odometry_from_camera, views)
    return 0 if up is None else quarter_turns_from_gravity(odometry_from_camera, up_odometry=up)


def quarter_turns_from_surfaces(
    views: Sequence[tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "3 3"]]],
) -> int:
    """Return the clockwise quarter turns (0..3) to upright without poses.

    Floors and tables are seen from above, so that surface normals point up on average.
    """
    lean = [found.mean(0) for found in (_normals(*view) for view in views) if len(found) >= MIN_POINTS]
    return quarter_turns_from_gravity(np.eye(4)[None], up_odometry=np.mean(lean, axis=0)) if lean else 0
