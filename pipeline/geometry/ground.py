"""Fit the ground plane in a world with +y up, and the up direction from a room's planes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry import align

VOTERS, CANDIDATES = 2000, 1500
"""number of normals that vote, and of candidate directions"""
VOTE_DEG = 6.0
"""angular width of a vote for directions parallel or perpendicular to a normal, degrees"""
FOCUS_MARGIN_M = 0.05
"""points up to this far above the focus count as below it"""
BIN_M = 0.02
"""bin size of the histogram of heights"""
LEVEL_SURFACE = 0.9
"""A surface whose normal has a larger vertical component is level."""
LEVEL_SHARE, LEVEL_BAND_M = 0.25, 0.03
"""Share of the largest level's area that a floor has; it is averaged over heights this close to its bin."""
BANDS_M = (0.05, 0.03, 0.02)
"""inlier distances of successive plane fits"""
AXIS_LIMITS_DEG = (6.0, 4.0)
"""inlier angles of successive direction fits"""


@dataclass(frozen=True)
class GroundPlane:
    """A nearly level plane: ``height(x, z) = offset + slope . (x, z)``."""

    offset_m: float
    slope: Float[np.ndarray, "2"]

    def above(self, points_world: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
        """Return heights above the ground."""
        return points_world[..., 1] - self.offset_m - points_world[..., [0, 2]] @ self.slope


def fit_ground(
    points_world: Float[np.ndarray, "point 3"], focus: Float[np.ndarray, "3"], reach_m: float = 0.5
) -> GroundPlane:
    """Fit the surface below the focus that most points within about ``reach_m`` of it lie on."""
    distance_m = np.linalg.norm((points_world - focus)[:, [0, 2]], axis=1)
    height = points_world[:, 1]
    weight = np.exp(-((distance_m / reach_m) ** 2)) * (height < focus[1] + FOCUS_MARGIN_M)
    bins = np.arange(height.min() - BIN_M, height.max() + 2 * BIN_M, BIN_M)
    counts, edges = np.histogram(height, bins, weights=weight)
    offset, slope = edges[counts.argmax()] + BIN_M / 2, np.zeros(2)
    for band in BANDS_M:
        close = np.abs(height - offset - points_world[:, [0, 2]] @ slope) < band
        design = np.column_stack([points_world[close][:, [0, 2]], np.ones(close.sum())]) * weight[close, None]
        solution = np.linalg.lstsq(design, height[close] * weight[close], rcond=None)[0]
        slope, offset = solution[:2], solution[2]
    return GroundPlane(float(offset), slope)


def lowest_level(height_m: Float[np.ndarray, "part"], area: Float[np.ndarray, "part"]) -> float:
    """Return the height of a floor, the lowest level with over a quarter of the largest's area; meters."""
    bins = np.arange(height_m.min() - BIN_M, height_m.max() + 2 * BIN_M, BIN_M)
    share, edges = np.histogram(height_m, bins, weights=area)
    lowest = edges[np.flatnonzero(share > LEVEL_SHARE * share.max())[0]] + BIN_M / 2
    near = np.abs(height_m - lowest) < LEVEL_BAND_M
    return float(np.average(height_m[near], weights=area[near]))


def floor_direction(
    normals_world: Float[np.ndarray, "point 3"], guess: Float[np.ndarray, "3"], within_deg: float = 40.0
) -> Float[np.ndarray, "3"]:
    """Return the up direction, within ``within_deg`` of a guess, that agrees with most of a room's normals.

    Normals parallel to it (floors, tables) vote with weight 1, perpendicular ones (walls) with 0.5; the best
    is refined by least squares.
    """
    voters = np.ascontiguousarray(normals_world[:: max(1, len(normals_world) // VOTERS)])
    candidates = _spherical_cap(guess, np.deg2rad(within_deg), CANDIDATES)
    cosine2 = (voters @ candidates.T) ** 2
    width2 = np.sin(np.deg2rad(VOTE_DEG)) ** 2
    votes = np.exp((cosine2 - 1) / width2).sum(0) + 0.5 * np.exp(-cosine2 / width2).sum(0)
    up = candidates[votes.argmax()]
    for limit_deg in AXIS_LIMITS_DEG:
        cosine = normals_world @ up
        along = np.abs(cosine) > np.cos(np.deg2rad(limit_deg))
        across = np.abs(cosine) < np.sin(np.deg2rad(limit_deg))
        if along.sum() + across.sum() < 10:
            break
        scatter = (
            normals_world[across].T @ normals_world[across] - normals_world[along].T @ normals_world[along]
        )
        axis = np.linalg.eigh(scatter)[1][:, 0]
        up = axis * np.sign(axis @ guess)
    return up


def _spherical_cap(
    center: Float[np.ndarray, "3"], radius_rad: float, count: int
) -> Float[np.ndarray, "direction 3"]:
    """Return directions on a Fibonacci spiral within an angle of a center, the center first."""
    share = np.arange(count) / count
    cosine, turn = 1 - share * (1 - np.cos(radius_rad)), np.pi * (3 - np.sqrt(5)) * np.arange(count)
    sine = np.sqrt(1 - cosine**2)
    around_z = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=-1)
    return around_z @ align.rotation_between(np.array([0.0, 0.0, 1.0]), center).T
