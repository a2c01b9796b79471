"""Path planning: from distant sub-goals to waypoints two seconds apart along paths over the free floor.

`WalkableFloor.of` finds the free floor; `plan_waypoints` plans paths between sub-goals around furniture and
splits them into two-second legs. Sub-goals come from the user, the behavior model or
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
"""A sub-goal whose root is this much higher than on the floor is on furniture, and reached by a jump."""
LEG_LENGTH_SLACK = 1.35
"""Maximum length of a leg, relative to the usual pace."""
SUPPORT_SEARCH_M = 0.3
"""Search range for a supporting surface above and below a raised sub-goal."""
LOWEST_ROOT = 0.7
"""A walking body needs free space from this share of its usual root height upwards."""
NARROW = 0.6
"""Upper bound of the required clearance, in root heights."""
NEAR_FURNITURE_M, BLOCKED_COST = 0.12, 80.0
"""Path cost: 5 beside furniture, decaying to 1 over this distance; and in blocked cells."""
PATH_SMOOTHING_CELLS = 3.0
"""Standard deviation of the Gaussian that smooths grid paths."""
MIN_STEP_M = 0.05
"""A shorter step defines no heading: the previous one is kept."""
BEYOND_M = 1.0
"""Margin of valid root heights above and below all surfaces of a scene."""
TURN_M = 0.2
"""A body that stops keeps this distance from blocked floor, to have room to turn."""
LANDING_CLEARANCE = 2.6
"""Preferred clearance, in root heights, where a jump takes off or lands: the body is stretched out."""
LARGE_TURN_RAD = 1.7
"""A larger turn at rest takes two legs."""
VISITED_CELL_M, APART_M = 0.25, 0.5
"""Cells in which visits are counted, and least distance of consecutive sampled sub-goals."""
MORE_LEGS = 4
"""Maximum number of legs beyond those that the pace requires, to keep legs out of furniture."""


@dataclass(frozen=True)
class Subgoal:
    """A target position, optionally with heading and time."""

    position_world: Float[np.ndarray, "3"]
    """of the root, meters; height NaN: on the floor"""
    heading_rad: float | None = None
    """heading about +y, from +z towards +x; None: free"""
    time_s: float | None = None
    """time of arrival; None: at the usual pace"""


@dataclass(frozen=True)
class Waypoints:
    """Level roots every two seconds."""

    world_from_agent: Float[np.ndarray, "place 4 4"]
    subgoal: np.ndarray
    """index of each sub-goal's waypoint"""


@dataclass(frozen=True)
class WalkableFloor:
    """Grid map of the floor that a body can walk on."""

    free: Bool[np.ndarray, "x z"]
    room_m: Float[np.ndarray, "x z"]
    """distance to the nearest blocked cell"""
    corner: Float[np.ndarray, "2"]
    """x and z of the first cell, world"""
    height_m: float
    """height of the floor, world"""
    lowest_m: float
    highest_m: float
    """range of valid root heights, world"""

    @classmethod
    def of(cls, scene: MotionScene, motion_prior: MotionPrior, breadth_m: float = 0.16) -> "WalkableFloor":
        """Return the largest connected area of floor that a walking body fits on."""
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

    def nearest_turning_place(self, position: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Return the nearest position with room to turn, the given one if it has."""
        room = self.room_m > TURN_M
        cell = np.array(self._nearest(room if room.any() else self.free, position))
        place = self.corner + CELL_M * cell
        stays = np.abs(place - position[[0, 2]]).max() <= CELL_M / 2
        return np.asarray(position) if stays else np.array([place[0], position[1], place[1]])

    def landing(self, position: Float[np.ndarray, "3"], root_m: float) -> Float[np.ndarray, "3"]:
        """Return where a jump takes off or lands: nearest, with missing `LANDING_CLEARANCE` counted twice."""
        cells = self._cells(self.room_m > min(TURN_M, self.room_m.max() / 2))
        distance = np.linalg.norm(self.corner + CELL_M * cells - np.asarray(position)[[0, 2]], axis=1)
        missing = np.maximum(0, LANDING_CLEARANCE * (root_m - self.height_m) - self.room_m[tuple(cells.T)])
        place = self.corner + CELL_M * cells[np.argmin(distance + 2 * missing)]
        return np.array([place[0], position[1], place[1]])

    def blocked_m(self, path: Float[np.ndarray, "point 3"]) -> float:
        """Return the length of a polyline over blocked cells, meters."""
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, [0, 2]], axis=0), axis=1))])
        query = np.arange(0, along[-1], CELL_M / 4)
        points = np.stack([np.interp(query, along, path[:, axis]) for axis in (0, 2)], axis=-1)
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
        offset = self.corner + CELL_M * cells - np.asarray(position)[[0, 2]]
        x, z = cells[np.argmin((offset**2).sum(1))]
        return int(x), int(z)

    def contains(self, position: Float[np.ndarray, "3"]) -> bool:
        """Return whether a position is within the scene's bounds; a NaN height is ignored."""
        place, height_m = (np.asarray(position)[[0, 2]] - self.corner) / CELL_M, position[1]
        within = np.isnan(height_m) or self.lowest_m <= height_m <= self.highest_m
        return bool(np.all(place >= 0) and np.all(place <= self.free.shape) and within)

    def refuse_outside(self, position: Float[np.ndarray, "3"]) -> None:
        """Raise SIM-003 for a world position, meters, outside the scene's bounds."""
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
        """Return a smooth least-cost path between two positions, away from furniture; x and z, meters."""
        cost = np.where(self.free, 1 + 4 * np.exp(-self.room_m / NEAR_FURNITURE_M), BLOCKED_COST)
        first, last = (self._nearest(self.free, each) for each in (start, end))
        cells, _ = route_through_array(cost, first, last)
        path = self.corner + CELL_M * np.array(cells, float)
        if len(path) <= 2:
            return path
        return gaussian_filter1d(path, PATH_SMOOTHING_CELLS, axis=0, mode="nearest")


def plan_waypoints(subgoals: list[Subgoal], scene: MotionScene, motion_prior: MotionPrior) -> Waypoints:
    """Return waypoints two seconds apart through all sub-goals, from the first one."""
    if len(subgoals) < 2:
        raise InputError("SIM-001", "too few sub-goals", f"{len(subgoals)}", "give at least two")
    floor = WalkableFloor.of(scene, motion_prior)
    for goal in subgoals:
        floor.refuse_outside(goal.position_world)
    root_m = floor.height_m + motion_prior.clearance_m
    stand = [_standing(floor, scene, goal.position_world, motion_prior.clearance_m) for goal in subgoals]
    points, headings, marks, clock = [stand[0]], [subgoals[0].heading_rad], [0], 0.0
    for goal, place in zip(subgoals[1:], stand[1:], strict=True):
        added = _leg_ends(floor, points[-1], place, root_m, LEG_LENGTH_SLACK * motion_prior.pace_m)
        count = len(added)
        spare = 0 if goal.time_s is None else max(0, round((goal.time_s - clock) / LEG_S) - count)
        points += [*added, *[added[-1]] * spare]
        headings += [None] * (count - 1) + [goal.heading_rad] * (1 + spare)
        clock += (count + spare) * LEG_S
        marks.append(len(points) - 1)
    return Waypoints(_poses_along_path(np.array(points), headings), np.array(marks))


def move_into_scene(subgoals: list[Subgoal], scene: MotionScene, motion_prior: MotionPrior) -> list[Subgoal]:
    """Move sub-goals outside the scene's bounds to the nearest place with room to turn."""
    floor = WalkableFloor.of(scene, motion_prior)
    return [
        goal
        if floor.contains(goal.position_world)
        else replace(goal, position_world=floor.nearest_turning_place(goal.position_world * [1, np.nan, 1]))
        for goal in subgoals
    ]


def sample_visited_subgoals(
    positions_world: Float[np.ndarray, "frame 3"], count: int, rng: np.random.Generator
) -> list[Subgoal]:
    """Sample sub-goals from visited cells in proportion to visits, consecutive ones apart."""
    places = np.floor(positions_world[:, [0, 2]] / VISITED_CELL_M)
    cells, number, visits = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    number, found = number.reshape(-1), []
    for _ in range(count):
        weight = visits.astype(float)
        if found:
            offset = (cells + 0.5) * VISITED_CELL_M - found[-1].position_world[[0, 2]]
            weight *= np.linalg.norm(offset, axis=1) > APART_M
        weight = weight if weight.sum() > 0 else visits.astype(float)
        chosen = rng.choice(len(cells), p=weight / weight.sum())
        found.append(Subgoal(np.median(positions_world[number == chosen], axis=0)))
    return found


def _standing(
    floor: WalkableFloor, scene: MotionScene, position: Float[np.ndarray, "3"], clearance_m: float
) -> Float[np.ndarray, "3"]:
    """Return the root of a body standing at a position: on supporting furniture, else where it can turn."""
    root_m = floor.height_m + clearance_m
    grounded = _grounded(position, root_m)
    if grounded[1] > root_m:
        above = _height_on_support(scene, grounded, clearance_m)
        grounded = _grounded(np.array([position[0], root_m if above is None else above, position[2]]), root_m)
    return floor.nearest_turning_place(grounded) if grounded[1] == root_m else grounded


def _height_on_support(
    scene: MotionScene, position: Float[np.ndarray, "3"], clearance_m: float
) -> float | None:
    """Return the root height nearest to the position's with support below and clearance around; None: none.

    A recorded position may have no support or too little room: furniture moves, and maps have errors.
    """
    heights = position[1] - clearance_m + np.arange(-SUPPORT_SEARCH_M, SUPPORT_SEARCH_M, 0.01)
    x, z = (np.full_like(heights, position[axis]) for axis in (0, 2))
    column = np.stack([x, heights, z], axis=-1)
    both = np.stack([column, column + np.array([0, clearance_m, 0])])
    below, root = scene.distance.at(torch.from_numpy(both).float()).numpy()
    surfaces = np.flatnonzero((below[:-1] < 0) & (below[1:] >= 0) & (root[1:] > clearance_m / 2)) + 1
    if not len(surfaces):
        return None
    found = heights[surfaces] + clearance_m
    return float(found[np.abs(found - position[1]).argmin()])


def _grounded(position: Float[np.ndarray, "3"], root_m: float) -> Float[np.ndarray, "3"]:
    """Set the root's usual height on a position without height or near the floor."""
    position = np.asarray(position, float)
    level = np.isnan(position[1]) or position[1] < root_m + RAISED_M
    return np.array([position[0], root_m if level else position[1], position[2]])


def _leg_ends(
    floor: WalkableFloor, start: np.ndarray, end: np.ndarray, root_m: float, longest_m: float
) -> list[Float[np.ndarray, "3"]]:
    """Return the ends of the legs from one root position to another; each jump is one leg."""
    ends = [(place, abs(place[1] - root_m) > 1e-6) for place in (start, end)]
    path = floor.path(*(floor.landing(place, root_m) if jumps else place for place, jumps in ends))
    ground = np.column_stack([path[:, 0], np.full(len(path), root_m), path[:, 1]])
    first, last = (ground[:0] if jumps else place[None] for place, jumps in ends)
    walked = np.concatenate([first, ground, last])
    landing, jump = [walked[0]] if ends[0][1] else [], [end] if ends[1][1] else []
    return [*landing, *_split_path(floor, walked, longest_m), *jump]


def _split_path(
    floor: WalkableFloor, path: Float[np.ndarray, "point 3"], longest_m: float
) -> list[Float[np.ndarray, "3"]]:
    """Return the ends of legs along a path: the fewest whose straight lines are least blocked."""
    fewest = max(1, int(np.ceil(np.linalg.norm(np.diff(path, axis=0), axis=1).sum() / longest_m)))
    candidates = [_resample_path(path, count) for count in range(fewest, fewest + MORE_LEGS + 1)]
    blocked = [floor.blocked_m(np.array([path[0], *points])) for points in candidates]
    return candidates[int(np.argmax(np.array(blocked) <= min(blocked) + CELL_M / 2))]


def _resample_path(path: Float[np.ndarray, "point 3"], count: int) -> list[Float[np.ndarray, "3"]]:
    """Return ``count`` points at equal arc lengths along a polyline, the last at its end."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    query = along[-1] * np.arange(1, count + 1) / count
    return list(np.stack([np.interp(query, along, path[:, axis]) for axis in range(3)], axis=-1))


def _poses_along_path(
    points: Float[np.ndarray, "place 3"], headings: list[float | None]
) -> Float[np.ndarray, "place 4 4"]:
    """Return poses heading along the path where no heading is given; large turns at rest take two legs."""
    yaw_rad = []
    for index, given in enumerate(headings):
        tangent = points[min(index + 1, len(points) - 1)] - points[max(index - 1, 0)]
        if given is None and np.linalg.norm(tangent[[0, 2]]) < MIN_STEP_M:
            given = yaw_rad[-1] if yaw_rad else 0.0
        yaw_rad.append(float(np.arctan2(tangent[0], tangent[2])) if given is None else given)
    for index in range(2, len(yaw_rad)):
        turn = float(rigid.wrap(yaw_rad[index] - yaw_rad[index - 1]))
        rests = np.linalg.norm(points[index - 2 : index + 1] - points[index], axis=1).max() < 1e-6
        if rests and headings[index - 1] is None and abs(turn) > LARGE_TURN_RAD:
            yaw_rad[index - 1] += turn / 2
    return rigid.make(rigid.rotation_from_yaw(np.array(yaw_rad)), points)
