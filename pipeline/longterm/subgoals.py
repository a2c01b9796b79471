"""From sub-goals far apart to places two seconds apart: ways over the free floor, cut into legs.

`WalkableFloor.of` finds where a body can stand; `plan_waypoints` leads from sub-goal to sub-goal around the
furniture and returns a place every two seconds. Sub-goals come from the user, the behaviour model or
`sample_visited_subgoals`.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt, gaussian_filter1d
from skimage.graph import route_through_array

from pipeline.core.errors import InputError
from pipeline.geometry import rigid
from pipeline.longterm.motion_synthesis import MotionPrior
from pipeline.longterm.short_motions import RATE_HZ, STEPS
from pipeline.longterm.surroundings import MotionScene

CELL_M = 0.08
LEG_S = STEPS / RATE_HZ
RAISED_M = 0.15
"""A sub-goal whose body stands higher than this above the floor is on furniture and is reached by a leap."""
LEG_LENGTH_SLACK = 1.35
"""How much longer than the usual pace a leg may be before another one is needed."""
SUPPORT_SEARCH_M = 0.3
"""How far above or below a raised sub-goal what carries a body there is looked for."""
LOWEST_ROOT = 0.7
"""A root that travels is free from this share of its usual height upwards."""
NARROW = 0.6
"""A broad body may come this close to the scene, in heights of its root."""
NEAR_FURNITURE_M, BLOCKED_COST = 0.12, 80.0
"""Free ground costs five times as much at furniture, falling off over this, and blocked ground so much."""
WAY_SMOOTHING_CELLS = 3.0
"""Deviation of the Gaussian that rounds the corners of a way on the grid."""
SHORTEST_WAY_M = 0.05
"""A shorter way has no direction: the heading before it stays."""
BEYOND_M = 1.0
"""No root is further above or below all surfaces of a scene."""
TURN_M = 0.2
"""A body that stops keeps this far from where it cannot walk, to have room to turn."""
LANDING_CLEARANCE = 2.6
"""A leap begins and ends so many root heights from where no body can walk: it falls full length."""
LARGE_TURN_RAD = 1.7
"""A turn of more than this takes a body at rest two legs."""
MORE_LEGS = 4
"""How many legs a way may have beyond what the pace asks for, so that none crosses furniture."""


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
class Waypoints:
    """Roots every two seconds, level, and which of them are the sub-goals."""

    world_from_agent: Float[np.ndarray, "place 4 4"]
    subgoal: np.ndarray
    """per sub-goal, the number of its place"""


@dataclass(frozen=True)
class WalkableFloor:
    """Where a body can walk, on cells of the ground."""

    free: Bool[np.ndarray, "x z"]
    room_m: Float[np.ndarray, "x z"]
    """distance from where it cannot"""
    corner: Float[np.ndarray, "2"]
    """x and z of the first cell, world"""
    height_m: float
    """of the floor, world"""
    lowest_m: float
    highest_m: float
    """heights between which a root may be, world"""

    @classmethod
    def of(cls, scene: MotionScene, motion_prior: MotionPrior, breadth_m: float = 0.16) -> "WalkableFloor":
        """Find the largest connected floor of a scene that a body, upright as it travels, can walk on."""
        floor, grid, root_m = scene.floor_m, scene.distance, motion_prior.clearance_m
        low, span = grid.origin.double().numpy(), (np.array(grid.values.shape) - 1) * grid.voxel_m
        count = np.floor(span[[0, 2]] / CELL_M).astype(int) + 1
        x, z = (low[axis] + CELL_M * np.arange(n) for axis, n in zip((0, 2), count, strict=True))
        top_m = root_m + max(motion_prior.above_m, 0.5 * root_m)
        levels = floor + np.linspace(LOWEST_ROOT * root_m, top_m, 5)
        points = np.stack(np.meshgrid(x, levels, z, indexing="ij"), axis=-1)
        above = grid.at(torch.from_numpy(points).float()).numpy()
        beneath = grid.at(torch.from_numpy(points[:, 0] * [1, 0, 1] + [0, floor, 0]).float()).numpy()
        free = (above.min(1) > np.minimum(breadth_m / 2, NARROW * root_m)) & (np.abs(beneath) < 0.1)
        _, area = cv2.connectedComponents(free.astype(np.uint8))
        free &= area == np.bincount(area[free], minlength=1).argmax()
        room_m, heights = CELL_M * np.asarray(distance_transform_edt(free)), scene.mesh.vertices[:, 1]
        ends = np.asarray(heights).min() - BEYOND_M, np.asarray(heights).max() + BEYOND_M
        return cls(free, room_m, low[[0, 2]], floor, *ends)

    def cell(self, position: Float[np.ndarray, "3"]) -> tuple[int, int]:
        """Return the free cell (x, z) nearest to a world position, metres."""
        return self._nearest(self.free, position)

    def nearest_turning_place(self, position: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Return a position where a body can turn: the given one if it can, else the nearest."""
        room = self.room_m > TURN_M
        cell = np.array(self._nearest(room if room.any() else self.free, position))
        place = self.corner + CELL_M * cell
        stays = np.abs(place - position[[0, 2]]).max() <= CELL_M / 2
        return np.asarray(position) if stays else np.array([place[0], position[1], place[1]])

    def landing(self, position: Float[np.ndarray, "3"], root_m: float) -> Float[np.ndarray, "3"]:
        """Return where a leap meets the ground: each metre missing to `LANDING_CLEARANCE` counts as two."""
        cells = self._cells(self.room_m > min(TURN_M, self.room_m.max() / 2))
        off = np.linalg.norm(self.corner + CELL_M * cells - np.asarray(position)[[0, 2]], axis=1)
        missing = np.maximum(0, LANDING_CLEARANCE * (root_m - self.height_m) - self.room_m[tuple(cells.T)])
        place = self.corner + CELL_M * cells[np.argmin(off + 2 * missing)]
        return np.array([place[0], position[1], place[1]])

    def blocked_m(self, way: Float[np.ndarray, "point 3"]) -> float:
        """Return how much of a polyline does not lead over free floor, metres."""
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way[:, [0, 2]], axis=0), axis=1))])
        where = np.arange(0, along[-1], CELL_M / 4)
        points = np.stack([np.interp(where, along, way[:, axis]) for axis in (0, 2)], axis=-1)
        cells = np.rint((points - self.corner) / CELL_M).astype(int)
        cells = np.clip(cells, 0, np.array(self.free.shape) - 1)
        return float((~self.free[tuple(cells.T)]).sum() * CELL_M / 4)

    def _cells(self, wanted: Bool[np.ndarray, "x z"]) -> Int[np.ndarray, "cell 2"]:
        cells = np.argwhere(wanted)
        if not len(cells):
            remedy = "give sub-goals in a scene that shows its floor"
            raise InputError("SIM-003", "there is no free floor in this scene", "", remedy)
        return cells

    def _nearest(self, wanted: Bool[np.ndarray, "x z"], position: Float[np.ndarray, "3"]) -> tuple[int, int]:
        cells = self._cells(wanted)
        off = self.corner + CELL_M * cells - np.asarray(position)[[0, 2]]
        x, z = cells[np.argmin((off**2).sum(1))]
        return int(x), int(z)

    def contains(self, position: Float[np.ndarray, "3"]) -> bool:
        """Return whether a position is within the scene's edges; one without height, if x and z are."""
        place, height_m = (np.asarray(position)[[0, 2]] - self.corner) / CELL_M, position[1]
        within = np.isnan(height_m) or self.lowest_m <= height_m <= self.highest_m
        return bool(np.all(place >= 0) and np.all(place <= self.free.shape) and within)

    def refuse_outside(self, position: Float[np.ndarray, "3"]) -> None:
        """Raise SIM-003 for a world position, metres, beyond the scene's edges."""
        if not self.contains(position):
            low, high = self.corner, self.corner + CELL_M * np.array(self.free.shape)
            heights = f"y {self.lowest_m:.1f} .. {self.highest_m:.1f} m (floor {self.height_m:.1f} m)"
            room = f"x {low[0]:.1f} .. {high[0]:.1f} m, {heights}, z {low[1]:.1f} .. {high[1]:.1f} m"
            axes = zip("xyz", position, strict=True)
            where = ", ".join(f"{axis} {value:g}" for axis, value in axes if not np.isnan(value))
            raise InputError("SIM-003", "a sub-goal lies outside the scene", where, f"the scene: {room}")

    def path(
        self, start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "point 2"]:
        """Return a smooth way over the ground between two positions, away from furniture; x and z, metres."""
        cost = np.where(self.free, 1 + 4 * np.exp(-self.room_m / NEAR_FURNITURE_M), BLOCKED_COST)
        cells, _ = route_through_array(cost, self.cell(start), self.cell(end))
        way = self.corner + CELL_M * np.array(cells, float)
        return gaussian_filter1d(way, WAY_SMOOTHING_CELLS, axis=0, mode="nearest") if len(way) > 2 else way


def plan_waypoints(
    start: Float[np.ndarray, "4 4"] | None,
    subgoals: list[Subgoal],
    scene: MotionScene,
    motion_prior: MotionPrior,
) -> Waypoints:
    """Return places two seconds apart through all sub-goals, from ``start`` or the first of them."""
    if len(subgoals) < (1 if start is not None else 2):
        remedy = "give at least two, or a start and one"
        raise InputError("SIM-001", "too few sub-goals", f"{len(subgoals)}", remedy)
    floor = WalkableFloor.of(scene, motion_prior)
    for goal in subgoals:
        floor.refuse_outside(goal.position_world)
    root_m = floor.height_m + motion_prior.clearance_m
    stand = [_standing(floor, scene, goal.position_world, motion_prior.clearance_m) for goal in subgoals]
    points = [stand.pop(0) if start is None else _grounded(start[:3, 3], root_m)]
    headings, marks, clock = [subgoals[0].heading_rad if start is None else float(rigid.yaw(start))], [0], 0.0
    for goal, place in zip(subgoals[-len(stand) :], stand, strict=True):
        added = _leg_ends(floor, points[-1], place, root_m, LEG_LENGTH_SLACK * motion_prior.pace_m)
        count = len(added)
        spare = 0 if goal.time_s is None else max(0, round((goal.time_s - clock) / LEG_S) - count)
        points += [*added, *[added[-1]] * spare]
        headings += [None] * (count - 1) + [goal.heading_rad] * (1 + spare)
        clock += (count + spare) * LEG_S
        marks.append(len(points) - 1)
    marks = marks if start is None else marks[1:]
    return Waypoints(_poses_along_path(np.array(points), headings), np.array(marks))


def move_into_scene(subgoals: list[Subgoal], scene: MotionScene, motion_prior: MotionPrior) -> list[Subgoal]:
    """Move sub-goals that a model drew outside of the scene to the nearest place where a body can turn."""
    floor = WalkableFloor.of(scene, motion_prior)
    return [
        goal
        if floor.contains(goal.position_world)
        else replace(goal, position_world=floor.nearest_turning_place(goal.position_world * [1, np.nan, 1]))
        for goal in subgoals
    ]


def sample_visited_subgoals(
    positions_world: Float[np.ndarray, "frame 3"],
    count: int,
    rng: np.random.Generator,
    *,
    cell_m: float = 0.25,
    apart_m: float = 0.5,
) -> list[Subgoal]:
    """Draw sub-goals from visited cells, often visited ones more often, consecutive ones well apart."""
    places = np.floor(positions_world[:, [0, 2]] / cell_m)
    cells, number, visits = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    number, found = number.reshape(-1), []
    for _ in range(count):
        weight = visits.astype(float)
        if found:
            away = (cells + 0.5) * cell_m - found[-1].position_world[[0, 2]]
            weight *= np.linalg.norm(away, axis=1) > apart_m
        weight = weight if weight.sum() > 0 else visits.astype(float)
        chosen = rng.choice(len(cells), p=weight / weight.sum())
        found.append(Subgoal(np.median(positions_world[number == chosen], axis=0)))
    return found


def _standing(
    floor: WalkableFloor, scene: MotionScene, position: Float[np.ndarray, "3"], clearance_m: float
) -> Float[np.ndarray, "3"]:
    """Return where a body at a position stands: on furniture that carries it, else where it can turn."""
    root_m = floor.height_m + clearance_m
    grounded = _grounded(position, root_m)
    if grounded[1] > root_m:
        above = _height_on_support(scene, grounded, clearance_m)
        grounded = _grounded(np.array([position[0], root_m if above is None else above, position[2]]), root_m)
    return floor.nearest_turning_place(grounded) if grounded[1] == root_m else grounded


def _height_on_support(
    scene: MotionScene, position: Float[np.ndarray, "3"], clearance_m: float
) -> float | None:
    """Return the height of the root nearest to a position's at which something carries the body and leaves it
    room; None: nowhere.

    Where an animal has been there may be nothing now, or a board at its belly: furniture is moved, maps are
    not perfect.
    """
    heights = position[1] - clearance_m + np.arange(-SUPPORT_SEARCH_M, SUPPORT_SEARCH_M, 0.01)
    x, z = (np.full_like(heights, position[axis]) for axis in (0, 2))
    column = np.stack([x, heights, z], axis=-1)
    both = np.stack([column, column + np.array([0, clearance_m, 0])])
    under, root = scene.distance.at(torch.from_numpy(both).float()).numpy()
    carries = np.flatnonzero((under[:-1] < 0) & (under[1:] >= 0) & (root[1:] > clearance_m / 2)) + 1
    if not len(carries):
        return None
    found = heights[carries] + clearance_m
    return float(found[np.abs(found - position[1]).argmin()])


def _grounded(position: Float[np.ndarray, "3"], root_m: float) -> Float[np.ndarray, "3"]:
    """Give a position without height, or one near the floor, the root's usual height."""
    position = np.asarray(position, float)
    level = np.isnan(position[1]) or position[1] < root_m + RAISED_M
    return np.array([position[0], root_m if level else position[1], position[2]])


def _leg_ends(
    floor: WalkableFloor, start: np.ndarray, end: np.ndarray, root_m: float, longest_m: float
) -> list[Float[np.ndarray, "3"]]:
    """Return the ends of the legs from one root position to another; onto and off furniture in one leap."""
    leaps = [abs(place[1] - root_m) > 1e-6 for place in (start, end)]
    both = zip((start, end), leaps, strict=True)
    way = floor.path(*(floor.landing(place, root_m) if leap else place for place, leap in both))
    ground = np.column_stack([way[:, 0], np.full(len(way), root_m), way[:, 1]])
    first, last = (
        ground[:0] if leap else place[None] for place, leap in zip((start, end), leaps, strict=True)
    )
    walked = np.concatenate([first, ground, last])
    off, onto = [walked[0]] if leaps[0] else [], [end] if leaps[1] else []
    return [*off, *_split_path(floor, walked, longest_m), *onto]


def _split_path(
    floor: WalkableFloor, way: Float[np.ndarray, "point 3"], longest_m: float
) -> list[Float[np.ndarray, "3"]]:
    """Return the ends of legs along a way: few, and as straight lines least blocked."""
    fewest = max(1, int(np.ceil(np.linalg.norm(np.diff(way, axis=0), axis=1).sum() / longest_m)))
    tried = [_resample_path(way, count) for count in range(fewest, fewest + MORE_LEGS + 1)]
    blocked = [floor.blocked_m(np.array([way[0], *points])) for points in tried]
    return tried[int(np.argmax(np.array(blocked) <= min(blocked) + CELL_M / 2))]


def _resample_path(stations: Float[np.ndarray, "point 3"], count: int) -> list[Float[np.ndarray, "3"]]:
    """Return ``count`` points at equal ways along a polyline, the last at its end."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(stations, axis=0), axis=1))])
    where = along[-1] * np.arange(1, count + 1) / count
    return list(np.stack([np.interp(where, along, stations[:, axis]) for axis in range(3)], axis=-1))


def _poses_along_path(
    points: Float[np.ndarray, "place 3"], headings: list[float | None]
) -> Float[np.ndarray, "place 4 4"]:
    """Head every place along the way, where no heading is given; at rest a large turn takes two legs."""
    turned = []
    for index, given in enumerate(headings):
        way = points[min(index + 1, len(points) - 1)] - points[max(index - 1, 0)]
        if given is None and np.linalg.norm(way[[0, 2]]) < SHORTEST_WAY_M:
            given = turned[-1] if turned else 0.0
        turned.append(float(np.arctan2(way[0], way[2])) if given is None else given)
    for index in range(2, len(turned)):
        about = (turned[index] - turned[index - 1] + np.pi) % (2 * np.pi) - np.pi
        rests = np.linalg.norm(points[index - 2 : index + 1] - points[index], axis=1).max() < 1e-6
        if rests and headings[index - 1] is None and abs(about) > LARGE_TURN_RAD:
            turned[index - 1] += about / 2
    vectors = np.zeros((len(turned), 3))
    vectors[:, 1] = turned
    return rigid.make(rigid.rotation_from_vector(vectors), points)
