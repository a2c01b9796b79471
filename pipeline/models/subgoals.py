"""From sub-goals far apart to places two seconds apart: ways over the free floor, cut into legs.

`Floor.of` finds where a body can stand; `legs` leads from sub-goal to sub-goal around the furniture and returns a place
every two seconds. Sub-goals come from the user, from the behaviour model, or from `preferred` spots.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d
from skimage.graph import route_through_array

from pipeline.errors import InputError
from pipeline.models.motion_synthesis import Habits
from pipeline.models.short_motions import RATE_HZ, STEPS
from pipeline.models.surroundings import Surroundings
from pipeline.space import rigid

CELL_M = 0.08
LEG_S = STEPS / RATE_HZ
RAISED_M = 0.15
"""A sub-goal whose body stands higher than this above the floor is on furniture and is reached by a leap."""
SLACK = 1.35
"""How much longer than the usual pace a leg may be before another one is needed."""


@dataclass(frozen=True)
class Subgoal:
    """A place to be at."""

    position_world: Float[np.ndarray, "3"]
    """of the root, metres"""
    heading_rad: float | None = None
    """direction of the head about +y, from +z towards +x; None: as it comes"""
    time_s: float | None = None
    """when; None: as fast as usual"""


@dataclass(frozen=True)
class Places:
    """Roots every two seconds, level, and which of them are the sub-goals."""

    world_from_agent: Float[np.ndarray, "place 4 4"]
    subgoal: np.ndarray
    """per sub-goal, the number of its place"""


@dataclass(frozen=True)
class Floor:
    """Where a body can walk, on cells of the ground."""

    free: Bool[np.ndarray, "x z"]
    clearance_m: Float[np.ndarray, "x z"]
    """distance from what stands, at the heights of the body"""
    corner: Float[np.ndarray, "2"]
    height_m: float

    @classmethod
    def of(cls, scene: Surroundings, root_m: float, breadth_m: float = 0.16) -> "Floor":
        """Find the free floor of a scene for a body whose root is ``root_m`` above ground."""
        floor, grid = scene.floor_m, scene.distance
        low, span = grid.origin.double().numpy(), (np.array(grid.values.shape) - 1) * grid.voxel_m
        count = np.floor(span[[0, 2]] / CELL_M).astype(int) + 1
        x, z = (low[axis] + CELL_M * np.arange(n) for axis, n in zip((0, 2), count, strict=True))
        levels = floor + np.linspace(0.7 * root_m, 1.5 * root_m, 4)
        points = np.stack(np.meshgrid(x, levels, z, indexing="ij"), axis=-1)
        above = grid.at(torch.from_numpy(points).float()).numpy()
        beneath = grid.at(torch.from_numpy(points[:, 0] * [1, 0, 1] + [0, floor, 0]).float()).numpy()
        clearance = above.min(1)
        free = (clearance > np.minimum(breadth_m / 2, 0.6 * root_m)) & (np.abs(beneath) < 0.1)
        return cls(free, clearance, low[[0, 2]], floor)

    def cell(self, position: Float[np.ndarray, "3"]) -> tuple[int, int]:
        """Return the free cell nearest to a position."""
        cells = np.argwhere(self.free)
        if not len(cells):
            raise InputError("SIM-003", "there is no free floor in this scene", "", "give sub-goals in a scene that shows its floor")
        off = self.corner + CELL_M * cells - np.asarray(position)[[0, 2]]
        return tuple(int(v) for v in cells[np.argmin((off**2).sum(1))])

    def refuse_outside(self, position: Float[np.ndarray, "3"]) -> None:
        """Raise SIM-003 for a position beyond the scene's edge."""
        low, high = self.corner, self.corner + CELL_M * np.array(self.free.shape)
        place = np.asarray(position)[[0, 2]]
        if np.any(place < low) or np.any(place > high):
            room = f"x {low[0]:.1f} .. {high[0]:.1f} m, z {low[1]:.1f} .. {high[1]:.1f} m"
            raise InputError("SIM-003", "a sub-goal lies outside the scene", f"x {place[0]:g}, z {place[1]:g}", f"the scene: {room}")

    def way(self, start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]) -> Float[np.ndarray, "point 2"]:
        """Return a way over the ground from near one position to near another, smooth, away from furniture."""
        cost = np.where(self.free, 1 + 1.5 * np.exp(-np.maximum(self.clearance_m - 0.1, 0) / 0.08), 80.0)
        cells, _ = route_through_array(cost, self.cell(start), self.cell(end), fully_connected=True, geometric=True)
        way = self.corner + CELL_M * np.array(cells, float)
        return gaussian_filter1d(way, 3.0, axis=0, mode="nearest") if len(way) > 2 else way


def legs(start: Float[np.ndarray, "4 4"] | None, subgoals: list[Subgoal], scene: Surroundings, habits: Habits) -> Places:
    """Return places two seconds apart through all sub-goals; without ``start`` the first sub-goal is where it begins."""
    if len(subgoals) < (1 if start is not None else 2):
        raise InputError("SIM-001", "too few sub-goals", f"{len(subgoals)}", "give at least two, or a start and one")
    floor = Floor.of(scene, habits.clearance_m)
    for goal in subgoals:
        floor.refuse_outside(goal.position_world)
    root_m = floor.height_m + habits.clearance_m
    here = subgoals[0].position_world if start is None else start[:3, 3]
    points, headings, marks, clock = [_grounded(here, root_m)], [subgoals[0].heading_rad if start is None else _heading(start)], [0], 0.0
    for goal in subgoals[1:] if start is None else subgoals:
        stations = _stations(floor, points[-1], _grounded(goal.position_world, root_m), root_m)
        length = float(np.linalg.norm(np.diff(stations, axis=0), axis=1).sum())
        count = max(1, int(np.ceil(length / (SLACK * habits.pace_m))))
        spare = 0 if goal.time_s is None else max(0, round((goal.time_s - clock) / LEG_S) - count)
        added = _spaced(stations, count)
        points += [*added, *[added[-1]] * spare]
        headings += [None] * (count - 1) + [goal.heading_rad] * (1 + spare)
        clock += (count + spare) * LEG_S
        marks.append(len(points) - 1)
    marks = marks if start is None else marks[1:]
    return Places(_facing(np.array(points), headings), np.array(marks))


def preferred(
    positions_world: Float[np.ndarray, "frame 3"], count: int, rng: np.random.Generator, *, cell_m: float = 0.25, apart_m: float = 0.5
) -> list[Subgoal]:
    """Draw sub-goals from the heatmap of visited places: often visited cells more often, neighbours well apart."""
    cells, number, visits = np.unique(np.floor(positions_world[:, [0, 2]] / cell_m), axis=0, return_inverse=True, return_counts=True)
    number, found = number.reshape(-1), []
    for _ in range(count):
        weight = visits.astype(float)
        if found:
            weight *= np.linalg.norm((cells + 0.5) * cell_m - found[-1].position_world[[0, 2]], axis=1) > apart_m
        weight = weight if weight.sum() > 0 else visits.astype(float)
        chosen = rng.choice(len(cells), p=weight / weight.sum())
        found.append(Subgoal(np.median(positions_world[number == chosen], axis=0)))
    return found


def _grounded(position: Float[np.ndarray, "3"], root_m: float) -> Float[np.ndarray, "3"]:
    """Give a position without height, or one near the floor, the root's usual height."""
    position = np.asarray(position, float)
    level = np.isnan(position[1]) or position[1] < root_m + RAISED_M
    return np.array([position[0], root_m if level else position[1], position[2]])


def _stations(floor: Floor, start: np.ndarray, end: np.ndarray, root_m: float) -> Float[np.ndarray, "point 3"]:
    """Return the way from one root position to another; up to and down from furniture in a straight line."""
    way = floor.way(start, end)
    ground = np.column_stack([way[:, 0], np.full(len(way), root_m), way[:, 1]])
    return np.concatenate([start[None], ground, end[None]])


def _spaced(stations: Float[np.ndarray, "point 3"], count: int) -> list[Float[np.ndarray, "3"]]:
    """Return ``count`` points at equal ways along a polyline, the last at its end."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(stations, axis=0), axis=1))])
    where = along[-1] * np.arange(1, count + 1) / count
    return list(np.stack([np.interp(where, along, stations[:, axis]) for axis in range(3)], axis=-1))


def _facing(points: Float[np.ndarray, "place 3"], headings: list[float | None]) -> Float[np.ndarray, "place 4 4"]:
    """Turn every place along the way through it, where no heading is given."""
    turned = []
    for index, given in enumerate(headings):
        way = points[min(index + 1, len(points) - 1)] - points[max(index - 1, 0)]
        if given is None and np.linalg.norm(way[[0, 2]]) < 0.05:
            given = turned[-1] if turned else 0.0
        turned.append(float(np.arctan2(way[0], way[2])) if given is None else given)
    vectors = np.zeros((len(turned), 3))
    vectors[:, 1] = turned
    return rigid.make(rigid.rotation_from_vector(vectors), points)


def _heading(world_from_agent: Float[np.ndarray, "4 4"]) -> float:
    return float(np.arctan2(world_from_agent[0, 2], world_from_agent[2, 2]))
