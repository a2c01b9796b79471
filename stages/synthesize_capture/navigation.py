"""Path planning around furniture: an occupancy grid, shortest paths on it, and path following."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from skimage.graph import route_through_array

from pipeline.geometry import rigid
from stages.synthesize_capture.room import DEPTH_M, WIDTH_M, Standing

CELL_M = 0.1
ANIMAL_M, PERSON_M = (0.46, 0.34), (0.40, 1.7)
"""Width and height of walkers."""
Ground = Float[np.ndarray, "2"]
"""A point (x, z) on the floor."""


@dataclass(frozen=True)
class Floor:
    """Grid of the cells that are free for a walker."""

    free: Bool[np.ndarray, "x z"]

    def cell(self, point: Ground) -> tuple[int, int]:
        """Return the cell that holds a point, clipped to the room."""
        i = int((point[0] + WIDTH_M / 2) / CELL_M)
        k = int((point[1] + DEPTH_M / 2) / CELL_M)
        return min(max(i, 0), self.free.shape[0] - 1), min(max(k, 0), self.free.shape[1] - 1)

    def is_free(self, point: Ground) -> bool:
        """Return whether a walker may stand there."""
        return bool(self.free[self.cell(point)])

    def centers(self) -> Float[np.ndarray, "cell 2"]:
        """Return the centers of all free cells."""
        return (np.argwhere(self.free) + 0.5) * CELL_M - [WIDTH_M / 2, DEPTH_M / 2]

    def nearest(self, point: Ground) -> Ground:
        """Return the point itself if free, else the center of the nearest free cell."""
        if self.is_free(point):
            return np.asarray(point, float)
        centers = self.centers()
        return centers[np.argmin(((centers - point) ** 2).sum(-1))]

    def route(
        self, start: Ground, goal: Ground, *, avoid: Ground | None = None
    ) -> Float[np.ndarray, "waypoint 2"]:
        """Return a shortest path that avoids ``avoid``; blocked cells are crossed as a last resort."""
        cost = np.where(self.free, 1.0, 60.0)
        if avoid is not None:
            x = (np.arange(self.free.shape[0]) + 0.5) * CELL_M - WIDTH_M / 2 - avoid[0]
            z = (np.arange(self.free.shape[1]) + 0.5) * CELL_M - DEPTH_M / 2 - avoid[1]
            cost = cost * (1 + 8 * np.exp(-(x[:, None] ** 2 + z[None, :] ** 2) / 0.5**2))
        cells, _ = route_through_array(
            cost, self.cell(start), self.cell(goal), fully_connected=True, geometric=True
        )
        way = (np.array(cells) + 0.5) * CELL_M - [WIDTH_M / 2, DEPTH_M / 2]
        if len(way) > 1:
            return np.concatenate([way[1:-1], np.asarray(goal, float)[None]])
        return np.asarray(goal, float)[None]


def floor_for(obstacles: Sequence[Standing], size_m: tuple[float, float]) -> Floor:
    """Return the free floor for a walker of this width and height between obstacles and walls."""
    x = (np.arange(round(WIDTH_M / CELL_M)) + 0.5) * CELL_M - WIDTH_M / 2
    z = (np.arange(round(DEPTH_M / CELL_M)) + 0.5) * CELL_M - DEPTH_M / 2
    x, z = np.meshgrid(x, z, indexing="ij")
    reach, height_m = size_m[0] / 2, size_m[1]
    free = (np.abs(x) < WIDTH_M / 2 - reach) & (np.abs(z) < DEPTH_M / 2 - reach)
    for block in obstacles:
        if block.piece.bottom < height_m:
            outside = np.maximum(block.axis_distance(x, z) - np.array(block.piece.size) / 2, 0)
            free &= np.linalg.norm(outside, axis=-1) >= reach
    return Floor(free)


class Walker:
    """Follows a path with limited angular speed and acceleration."""

    def __init__(self, floor: Floor, position: Ground, yaw: float, *, turn_rate: float, acceleration: float):
        self.floor, self.position, self.yaw = floor, np.asarray(position, float), yaw
        self.turn_rate, self.acceleration = turn_rate, acceleration
        self.speed = 0.0
        self.way: np.ndarray = np.zeros((0, 2))

    def go(self, goal: Ground, *, avoid: Ground | None = None) -> None:
        """Plan the path to a goal."""
        self.way = self.floor.route(self.position, self.floor.nearest(goal), avoid=avoid)

    def stop(self) -> None:
        """Discard the path."""
        self.way = np.zeros((0, 2))

    def arrived(self) -> bool:
        """Return whether the path is finished."""
        return len(self.way) == 0

    def step(self, seconds: float, desired_speed: float, *, face: float | None = None) -> None:
        """Advance, heading along the path or, if given, towards the angle ``face`` (a person who films)."""
        while len(self.way) and np.linalg.norm(self.way[0] - self.position) < (
            0.22 if len(self.way) > 1 else 0.05 + 0.06 * self.speed
        ):
            self.way = self.way[1:]
        target_speed, heading = 0.0, self.yaw
        if len(self.way):
            toward = self.way[0] - self.position
            heading = float(np.arctan2(toward[0], toward[1]))
            left = np.linalg.norm(self.way[-1] - self.position)
            target_speed = min(
                desired_speed, np.sqrt(2 * 0.8 * self.acceleration * max(left - 0.03, 0.0)) + 0.08
            )
        error = rigid.wrap((heading if face is None else face) - self.yaw)
        self.yaw += float(np.clip(error, -self.turn_rate * seconds, self.turn_rate * seconds))
        if face is None:
            target_speed *= max(np.cos(rigid.wrap(heading - self.yaw)), 0.0) ** 2
            heading = self.yaw
        change = self.acceleration * seconds
        self.speed += float(np.clip(target_speed - self.speed, -1.6 * change, change))
        ahead = self.position + self.speed * seconds * np.array([np.sin(heading), np.cos(heading)])
        if self.floor.is_free(ahead) or not self.floor.is_free(self.position):
            self.position = ahead
        else:
            self._slide(ahead)

    def _slide(self, ahead: Ground) -> None:
        for along_axis in (np.array([ahead[0], self.position[1]]), np.array([self.position[0], ahead[1]])):
            if self.floor.is_free(along_axis):
                self.position = along_axis
                return
        self.speed *= 0.5
