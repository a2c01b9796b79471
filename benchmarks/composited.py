"""Composite built-in animals into a real RGB-D sequence, for `semi_real`.

`Sequence` reads a recording with depth of any known format; `surfaces` finds walkable surfaces; `course` samples a trajectory on which
the animal walks, rests, and enters and leaves the scene; `Compositor` renders each frame, with occlusion by the
sequence's depth and with its measured noise and holes. World: that of the sequence, rotated so that +y is up, meters.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numba import njit
from scipy import ndimage

from pipeline.core.errors import InputError
from pipeline.core.progress import log
from pipeline.geometry import cameras, rigid
from pipeline.mapping.icp import DepthImage, depth_image
from pipeline.mapping.odometry import Guess, align_gravity, chain_alignments, correct_drift
from pipeline.recordings import errors, extraction
from pipeline.recordings.extraction import ExtractionPlan
from pipeline.recordings.formats import open_recording
from pipeline.recordings.recording import Recording
from stages.synthesize_capture import animal, gait, raster, shade
from stages.synthesize_capture.session import STEP_S, AnimalCourse

PROJECTOR_BASELINE_M = 0.075
"""Kinect v1: from infrared projector to infrared camera; surfaces in the projector's shadow have no depth"""
NO_SHADOW = 1e-3
"""share of pixels without depth beside a nearer surface below which a sensor has no projector shadow"""
FARTHEST_M = 6.0
PICTURE_SIDE_PX, VIEW_SIDE_PX = 640, 160
"""longer sides to which pictures, and points for surfaces, are reduced"""
EVERY_FRAME_HZ = 1000.0
"""rate at which no frame of a recording is skipped"""
MARGIN = 50 / 640
"""the animal's target is at least this far inside the picture, share of its longer side"""
CELL_M = 0.04
ABSENT_M = 100.0
"""depth below the world at which an absent animal is placed"""


@dataclass(frozen=True)
class Sequence:
    """Frames of a recording in any format that the pipeline reads: upright, with one pinhole for all of them.

    Its reader decides whether depth must be reprojected into the color camera.
    """

    recording: Recording
    plan: ExtractionPlan
    rows: tuple[int, ...]
    """frames of the plan, in the order in which they are shown"""

    @classmethod
    def open(cls, path: Path, *, first: int = 0, last: int = 10**9, step: int = 1) -> "Sequence":
        """Open the frames from number ``first`` to ``last``, every ``step``-th; a negative step reverses them.

        Raises InputError CAP-001..011 for recordings without usable frames or depth.
        """
        recording = open_recording(path)
        for remark in recording.remarks:
            log(f"{recording.where}: {remark}")
        plan = extraction.understand(
            recording, rate_hz=EVERY_FRAME_HZ, max_depth_m=FARTHEST_M, max_side_px=PICTURE_SIDE_PX
        )
        log(extraction.summary(recording, plan))
        number = recording.index[plan.chosen]
        rows = np.flatnonzero((number >= first) & (number <= last))[::step]
        if len(rows) < extraction.MIN_FRAMES:
            what = (
                f"{len(rows)} of {len(number)} frames are left, at least {extraction.MIN_FRAMES} are needed"
            )
            raise InputError("CAP-007", what, recording.where, "choose other --first, --last and --step")
        return cls(recording, plan, tuple(rows.tolist()))

    @property
    def numbers(self) -> Int[np.ndarray, "frame"]:
        """Return the frame numbers of the recording."""
        return self.recording.index[self.plan.chosen[list(self.rows)]]

    @property
    def timestamp_s(self) -> Float[np.ndarray, "frame"]:
        """Return seconds since the first frame shown, increasing."""
        stored = self.plan.timestamp_s[list(self.rows)]
        return np.abs(stored - stored[0])

    @property
    def size(self) -> tuple[int, int]:
        """Return (height, width) of the pictures."""
        return self._upright(self.plan.stored_size)

    @property
    def depth_size(self) -> tuple[int, int]:
        """Return (height, width) of depth."""
        return self.depth(0).shape

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """Return the intrinsics of the pictures, pixels: the median over the frames."""
        return np.median(self.plan.intrinsics[list(self.rows)], axis=0)

    def color(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """Read a picture, RGB. Raises InputError CAP-001 if it is damaged."""
        row = int(self.plan.chosen[self.rows[index]])
        stored = extraction.picture(self.recording, row, self.plan.stored_size)
        if stored is None:
            raise errors.damaged(self.recording.where, f"frame {self.recording.index[row]} has no picture")
        return np.ascontiguousarray(cameras.turn_image(stored, self.plan.quarter_turns))

    def depth(self, index: int) -> Float[np.ndarray, "depth_height depth_width"]:
        """Read depth, meters; 0 where it is unknown or of low confidence."""
        number = int(self.recording.index[self.plan.chosen[self.rows[index]]])
        depth = extraction.stored_depth(self.recording, number, FARTHEST_M)
        if self.recording.read_confidence is not None:
            depth = np.where(extraction.confidence_of(self.recording, number, depth) > 0, depth, 0)
        return np.ascontiguousarray(cameras.turn_image(depth, self.plan.quarter_turns), np.float32)

    def poses(self) -> Float[np.ndarray, "frame 4 4"]:
        """Return `world_from_camera` with +y up: the recording's poses, else odometry by aligned depth."""
        if self.plan.odometry_from_camera is not None:
            given = self.plan.odometry_from_camera[list(self.rows)]
            return given if self.plan.gravity_known else align_gravity(self.view, given)
        chained = chain_alignments(self.view, lambda _, last: Guess(last), len(self.rows))
        found = correct_drift(self.view, self.timestamp_s, chained)
        log(f"{self.recording.where}: no poses; depth is aligned, residual {1000 * found.residual_m:.1f} mm")
        return align_gravity(self.view, found.world_from_camera)

    def view(self, index: int) -> DepthImage:
        """Return points and normals of a frame, camera axes."""
        depth = self.depth(index)
        intrinsics = cameras.scale_intrinsics(self.intrinsics, self.size, depth.shape)
        return depth_image(depth, intrinsics, depth > 0, max(1, max(depth.shape) // VIEW_SIDE_PX))

    def _upright(self, size: tuple[int, int]) -> tuple[int, int]:
        return size if self.plan.quarter_turns % 2 == 0 else (size[1], size[0])


@dataclass(frozen=True)
class Noise:
    """Sensor noise measured on the sequence."""

    coefficients: Float[np.ndarray, "3"]
    """Standard deviation of depth in meters as a polynomial of z in meters, constant last."""
    shadow_side: int
    """Side of a nearer surface on which depth is missing (projector shadow): -1 left, 1 right, 0 neither."""
    color: float
    """Standard deviation of the color noise, 0..255."""


def measure_noise(sequence: Sequence, frames: int = 12) -> Noise:
    """Measure depth noise against local planes by range, the side of the projector shadow, and color noise."""
    ranges, errors, sides, grain = [], [], np.zeros(2), []
    for index in np.linspace(0, len(sequence.numbers) - 1, frames).astype(int).tolist():
        depth = sequence.depth(index)
        inverse = np.where(depth > 0, 1 / np.maximum(depth, 0.1), 0)  # a plane is linear in 1 / z
        flat = cv2.erode((depth > 0).astype(np.uint8), np.ones((9, 9))) > 0
        jump = cv2.dilate(depth, np.ones((9, 9))) - cv2.erode(depth, np.ones((9, 9)))
        flat &= jump < 0.1
        error = np.abs(inverse - cv2.blur(inverse, (9, 9))) * depth**2
        ranges.append(depth[flat]), errors.append(error[flat])
        hole = depth == 0
        for side, shift in ((1, -4), (0, 4)):
            near, far = np.roll(depth, -shift * 4, 1), np.roll(depth, shift * 2, 1)
            sides[side] += (hole & (near > 0) & (far > near + 0.3)).sum()
        gray = cv2.cvtColor(sequence.color(index), cv2.COLOR_RGB2GRAY).astype(np.float32)
        grain.append(np.median(np.abs(gray - cv2.medianBlur(gray, 3))) * 1.48)
    z, error = np.concatenate(ranges), np.concatenate(errors)
    bins = np.arange(0.6, FARTHEST_M, 0.25)
    middle = [
        (low + 0.125, 1.48 * np.median(error[(z > low) & (z < low + 0.25)]))
        for low in bins
        if ((z > low) & (z < low + 0.25)).sum() > 500
    ]
    coefficients = (
        np.polyfit([at for at, _ in middle], [sigma for _, sigma in middle], 2)
        if len(middle) > 3
        else np.array([0.0015, 0, 0.001])
    )
    side = 0 if sides.max() < NO_SHADOW * frames * depth.size else -1 if sides[0] > sides[1] else 1
    return Noise(coefficients, side, max(float(np.median(grain)), 1.0))


@dataclass(frozen=True)
class Surface:
    """A horizontal surface: its height, per cell too, and the cells of (x, z) on which an animal can stand."""

    height_m: float
    heights_m: Float[np.ndarray, "x z"]
    """differ by pose errors of one to two centimeters, and because real tables are not exactly level"""
    free: Bool[np.ndarray, "x z"]
    origin: Float[np.ndarray, "2"]

    def points(self) -> Float[np.ndarray, "cell 3"]:
        """Return the free cells' centers, world."""
        at = self.origin + (np.argwhere(self.free) + 0.5) * CELL_M
        return np.stack([at[:, 0], self.heights_m[self.free], at[:, 1]], axis=1)

    def connects(self, a: np.ndarray, b: np.ndarray) -> bool:
        """Return whether the straight line between two points is free."""
        way = a + np.linspace(0, 1, max(2, int(np.linalg.norm(b - a) / (CELL_M / 2))))[:, None] * (b - a)
        at = np.floor((way[:, [0, 2]] - self.origin) / CELL_M).astype(int)
        return bool(self.free[at[:, 0], at[:, 1]].all())


def surfaces(sequence: Sequence, world_from_camera: np.ndarray) -> list[Surface]:
    """Find horizontal surfaces with free space for an animal, largest first."""
    points, up = [], []
    every = int(np.clip(len(sequence.numbers) // 3, 1, 8))
    for index in range(0, len(sequence.numbers), every):
        view = sequence.view(index)
        seen = view.points[..., 2] > 0
        points.append(rigid.apply(world_from_camera[index], view.points[seen].astype(float)))
        up.append(view.normals[seen] @ world_from_camera[index, :3, :3].T[:, 1] > 0.93)
    points, up = np.concatenate(points), np.concatenate(up)
    origin = points.min(0) - 0.2
    shape = tuple(np.ceil((points.max(0) + 0.2 - origin)[[0, 2]] / CELL_M).astype(int))
    at = np.floor((points[:, [0, 2]] - origin[[0, 2]]) / CELL_M).astype(int)
    edges = np.arange(points[:, 1].min(), points[:, 1].max() + 0.04, 0.04)
    count, _ = np.histogram(points[up, 1], edges)
    found = []
    for peak in np.argsort(-count)[:8]:
        level = up & (np.abs(points[:, 1] - edges[peak] - 0.02) < 0.04)
        if level.sum() < 300:
            continue
        height = float(np.median(points[level, 1]))
        if any(abs(height - other.height_m) < 0.1 for other in found):
            continue
        support, above = np.zeros(shape, int), np.zeros(shape, int)
        np.add.at(support, tuple(at[level].T), 1)
        np.add.at(above, tuple(at[(points[:, 1] > height + 0.06) & (points[:, 1] < height + 0.4)].T), 1)
        free = np.array(ndimage.binary_closing(support >= 2)) & ~ndimage.binary_dilation(
            above >= 4, iterations=3
        )
        free = ndimage.binary_erosion(free, iterations=3)
        if free.sum() * CELL_M**2 > 0.05:
            total = np.zeros(shape)
            np.add.at(total, tuple(at[level].T), points[level, 1] - height)
            smooth = ndimage.gaussian_filter(total, 3) / np.maximum(
                ndimage.gaussian_filter(support * 1.0, 3), 1e-3
            )
            found.append(Surface(height, height + smooth, free, origin[[0, 2]]))
    return sorted(found, key=lambda surface: -surface.free.sum())


def course(
    sequence: Sequence,
    world_from_camera: np.ndarray,
    timestamp_s: np.ndarray,
    walkable: list[Surface],
    rng: np.random.Generator,
) -> tuple[AnimalCourse, Bool[np.ndarray, "frame"]]:
    """Sample a trajectory on which the animal appears, walks between points in view, rests there and disappears;
    return it and the frames with the animal.
    """
    steps = np.arange(int(np.ceil((timestamp_s[-1] + 2) / STEP_S))) * STEP_S
    position = np.tile([0.0, -ABSENT_M, 0.0], (len(steps), 1))
    yaw, posture, air = np.zeros(len(steps)), np.zeros((len(steps), 3)), np.zeros(len(steps))
    present, now = np.zeros(len(steps), bool), rng.uniform(0.5, 3.0)
    while now < steps[-1] - 2.5:
        stay = rng.uniform(3.0, 7.5)
        chosen = np.flatnonzero((steps >= now) & (steps < now + stay))
        frame = int(np.argmin(np.abs(timestamp_s - now - 0.4 * stay)))
        walk = _walk(sequence, world_from_camera[frame], frame, walkable, len(chosen), rng)
        if walk is not None:
            position[chosen], yaw[chosen], posture[chosen], air[chosen] = walk
            present[chosen] = True
        now += stay + rng.uniform(1.5, 5.0)
    gaze = position + np.stack([np.sin(yaw), np.full(len(yaw), 0.25), np.cos(yaw)], axis=1)
    made = AnimalCourse(steps, position, yaw, posture, air, gaze, np.full(len(steps), 0.2))
    return made, np.interp(timestamp_s, steps, present.astype(float)) > 0.999


def _walk(sequence, world_from_camera, frame, walkable, count, rng):
    """Walk and rest for ``count`` steps within view of a frame, climbing over the edge at the start and the end."""
    height, width = sequence.size
    middle, margin = np.array([width, height]) / 2, MARGIN * max(width, height)
    for _ in range(40 if walkable else 0):
        surface = walkable[min(int(rng.exponential(0.8)), len(walkable) - 1)]
        cells = surface.points()
        pixel, z = cameras.project(rigid.apply(rigid.inverse(world_from_camera), cells), sequence.intrinsics)
        inside = (np.abs(np.asarray(pixel) - middle) < middle - margin).all(1) & (z > 0.7) & (z < 3.5)
        measured = resampled(sequence.depth(frame), sequence.size)
        at = np.clip(np.asarray(pixel).astype(int), 0, [width - 1, height - 1])
        measured = measured[at[:, 1], at[:, 0]]
        seen = cells[inside & (measured > z - 0.08)]
        if len(seen) >= 4:
            break
    else:
        return None
    here = seen[rng.integers(len(seen))]
    places, headings, rests, heading = [], [], [], rng.uniform(-np.pi, np.pi)
    while len(places) < count:
        target = cells[rng.integers(len(cells))]
        if rng.random() < 0.35 or not surface.connects(here, target):
            wait = int(rng.uniform(0.3, 1.6) / STEP_S)
            kind = np.eye(3)[rng.integers(2)] * (rng.random() < 0.6)
            places += [here] * wait
            headings += [heading] * wait
            rests += [kind] * wait
            continue
        step_m = rng.uniform(0.2, 0.6) * STEP_S
        way = here + np.linspace(0, 1, max(2, int(np.linalg.norm(target - here) / step_m)))[:, None] * (
            target - here
        )
        heading = float(np.arctan2(*(target - here)[[0, 2]]))
        places += list(way)
        headings += [heading] * len(way)
        rests += [np.zeros(3)] * len(way)
        here = target
    position = np.array(places[:count])
    yaw = ndimage.gaussian_filter1d(np.unwrap(np.array(headings[:count])), 5, mode="nearest")
    posture = ndimage.gaussian_filter1d(np.array(rests[:count]), 5, axis=0, mode="nearest")
    rise = int(0.5 / STEP_S)
    air = np.zeros(count)
    for end in (slice(0, rise), slice(count - 1, count - 1 - rise, -1)):
        position[end, 1] -= 0.45 * np.linspace(1, 0, rise) ** 2
        air[end] = 1
    return position, yaw, posture, air


_EMPTY = shade.Backdrop(
    np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3, 2)), np.zeros(0, np.int32),
    np.zeros((0, 3), np.float32), np.zeros(1, np.uint8), np.zeros((0, 8, 3), np.int64),
    np.zeros(0, np.float32),
)  # fmt: skip
"""an empty room: only the animal is rendered"""


@dataclass(frozen=True)
class Composite:
    """One frame with the animal, all of the picture's size, and its ground truth."""

    color: UInt8[np.ndarray, "height width 3"]
    depth: Float[np.ndarray, "height width"]
    masks: Bool[np.ndarray, "animal height width"]
    """visible parts; disjoint"""


@dataclass(frozen=True)
class Actor:
    """An animal and what it does in a sequence."""

    creature: animal.Animal
    motion: gait.AnimalMotion
    present: Bool[np.ndarray, "frame"]


class Compositor:
    """Renders animals into frames of a sequence."""

    def __init__(self, sequence: Sequence, actors: list[Actor], noise: Noise, rng: np.random.Generator):
        self.sequence, self.actors, self.noise, self._rng = sequence, actors, noise, rng
        pictures = [sequence.color(i) for i in np.linspace(0, len(sequence.numbers) - 1, 8).astype(int)]
        self._light = np.mean([((p / 255.0) ** 2.2).mean((0, 1)) for p in pictures], axis=0) / 0.3
        """for an average albedo of 30 %, linear RGB"""

    def frames(self, world_from_camera: Float[np.ndarray, "frame 4 4"]) -> Iterator[Composite]:
        """Render every frame, in order; of bodies that overlap in the picture the nearer one is visible."""
        turned = rigid.vector_from_rotation(
            np.swapaxes(world_from_camera[:-1, :3, :3], -1, -2) @ world_from_camera[1:, :3, :3]
        )
        turned = np.concatenate([turned, turned[-1:]])
        for index, turn in enumerate(turned):
            color = self.sequence.color(index)
            depth = resampled(self.sequence.depth(index), color.shape[:2])
            masks, front = np.zeros((len(self.actors), *depth.shape), bool), _fill_holes(depth)
            blur = 0.15 * self.sequence.intrinsics[0, 0] * np.array([-turn[1], turn[0]])
            for row, actor in enumerate(self.actors):
                if actor.present[index]:
                    color, depth, own = self._draw(
                        color, depth, front, world_from_camera[index], actor, index, blur
                    )
                    front, masks[row] = np.where(own > 0, own, front), own > 0
                    masks[:row] &= own == 0
            yield Composite(color, depth, masks)

    def _draw(self, color, depth, front, world_from_camera, actor: Actor, index: int, blur_px):
        """Return color, measured depth, and exact depth where the animal is seen, 0 elsewhere; ``front``: what may hide it."""
        height, width = depth.shape
        creature, motion = actor.creature, actor.motion
        camera_from_world = rigid.inverse(world_from_camera)
        camera_from_bone = camera_from_world @ motion.world_from_agent[index] @ motion.agent_from_bone[index]
        body = animal.surface(creature, camera_from_bone)
        k = self.sequence.intrinsics
        focal = (k[0, 0], k[1, 1], k[0, 2], k[1, 2])
        if body[:, 2].max() < 0.3:
            return color, depth, np.zeros(depth.shape)
        view = raster.rasterize(body, creature.faces, np.diag([2, 2, 1]) @ k, 2 * height, 2 * width)
        normals = animal.normals_of(body, creature.faces) @ world_from_camera[:3, :3].T
        irradiance = (
            0.45 + 0.4 * (0.5 + 0.5 * normals[:, 1:2]) + 0.25 * np.clip(normals[:, :1], 0, 1)
        ) * self._light
        anatomy = creature.anatomy
        balls = np.zeros((len(anatomy.balls()), 4))
        for row, (bone, rest, radius) in enumerate(anatomy.balls()):
            local = np.asarray(rest) - anatomy.heads[animal.INDEX[bone]]
            balls[row] = *rigid.apply(camera_from_bone[animal.INDEX[bone]], local[None])[0], radius
        coat = shade.Coat(
            creature.faces, creature.vertices, irradiance.astype(np.float32), creature.fur, balls
        )
        fur = shade.shade(view.face, view.inverse_corners, focal, _EMPTY, coat, camera_from_world)
        own = raster.depth_through(view.face, view.inverse_depth, view.inverse_corners, focal, height, width)
        coverage = cv2.resize(
            (view.face >= 0).astype(np.float32), (width, height), interpolation=cv2.INTER_AREA
        )
        hidden = (front < own - 0.012 - 0.01 * own) & (own > 0)
        coverage[hidden], fur[hidden] = 0, 0
        if not (coverage >= 0.5).any():
            return color, depth, np.zeros(depth.shape)
        shading = _contact_shadow(front, np.asarray(focal), camera_from_world[:3, 1].copy(), balls)
        room = (color / 255.0).astype(np.float32) ** 2.2 * shading[..., None]
        layer = _motion_blurred(
            cv2.GaussianBlur(np.dstack([fur, coverage]).astype(np.float32), (0, 0), 0.7), blur_px
        )
        linear = layer[..., :3] + room * (1 - layer[..., 3:])
        shown = 255 * np.clip(linear, 0, 1) ** (1 / 2.2)
        shown += layer[..., 3:] * self._rng.normal(0, self.noise.color, shown.shape)
        own = own * (coverage >= 0.5)
        return np.clip(shown, 0, 255).astype(np.uint8), self._sensor_depth(depth, own), own

    def _sensor_depth(self, room: np.ndarray, own: np.ndarray) -> Float[np.ndarray, "height width"]:
        """Return depth as the sensor measures it: correlated noise, a jittered outline, the projector shadow."""
        height, width = room.shape
        bend = cv2.resize(
            self._rng.standard_normal((height // 8, width // 8, 2)).astype(np.float32), (width, height)
        )
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        own = cv2.remap(own.astype(np.float32), x + bend[..., 0], y + bend[..., 1], cv2.INTER_NEAREST)
        shadow = _projector_shadow(
            own,
            _fill_holes(room),
            self.sequence.intrinsics[0, 0] * PROJECTOR_BASELINE_M,
            self.noise.shadow_side,
        )
        sigma = np.maximum(np.polyval(self.noise.coefficients, own), 0.001)
        grain = cv2.GaussianBlur(self._rng.standard_normal(own.shape), (0, 0), 1.5) * 5.3
        own = np.where(own > 0, own + sigma * grain, 0)
        slant = cv2.morphologyEx(own, cv2.MORPH_GRADIENT, np.ones((3, 3))) / np.maximum(own, 0.3)
        lost = (own > 0) & (slant > 0.03) & (bend[..., 0] > 0.8)
        out = np.where(own > 0, np.where(lost, 0, own), np.where(shadow, 0, room))
        return out.astype(np.float32)


def resampled(depth: np.ndarray, size: tuple[int, int]) -> Float[np.ndarray, "height width"]:
    """Resize depth to a (height, width) by nearest neighbor."""
    same = depth.shape == size
    return depth if same else cv2.resize(depth, size[::-1], interpolation=cv2.INTER_NEAREST_EXACT)


@lru_cache(maxsize=1)
def _nearest_known(shape, data):
    depth = np.frombuffer(data, np.float32).reshape(shape)
    return np.array(ndimage.distance_transform_edt(depth == 0, return_distances=False, return_indices=True))


def _fill_holes(depth: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Fill unknown pixels with the nearest known depth."""
    rows, columns = _nearest_known(depth.shape, np.ascontiguousarray(depth, np.float32).tobytes())
    return depth[rows, columns]


@njit(cache=True)
def _projector_shadow(own, room, focal_baseline, side):
    """Mark pixels that the animal occludes from the projector: as wide as the disparity between both surfaces."""
    height, width = own.shape
    out = np.zeros((height, width), np.bool_)
    for i in range(height):
        for j in range(width):
            if own[i, j] > 0:
                for step in range(1, 60):
                    u = j + side * step
                    if u < 0 or u >= width or own[i, u] > 0:
                        break
                    if step > focal_baseline * (1 / own[i, j] - 1 / max(room[i, u], 0.3)):
                        break
                    out[i, u] = True
    return out


@njit(cache=True)
def _contact_shadow(depth, focal_center, up_camera, balls):
    """Return the fraction of light on horizontal ground near the animal (analytic sphere occlusion)."""
    out = np.ones(depth.shape, np.float32)
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            z = depth[i, j]
            x = (j + 0.5 - focal_center[2]) / focal_center[0] * z
            y = (i + 0.5 - focal_center[3]) / focal_center[1] * z
            lost = 0.0
            for ball in range(balls.shape[0]):
                dx, dy, dz = balls[ball, 0] - x, balls[ball, 1] - y, balls[ball, 2] - z
                squared = dx * dx + dy * dy + dz * dz
                if squared < 0.3:
                    facing = (up_camera[0] * dx + up_camera[1] * dy + up_camera[2] * dz) / np.sqrt(squared)
                    lost += max(facing, 0.0) * min(balls[ball, 3] ** 2 / max(squared, 1e-6), 0.9)
            out[i, j] = max(1 - 0.9 * lost, 0.35)
    return out


def _motion_blurred(picture: np.ndarray, blur_px: np.ndarray) -> np.ndarray:
    """Apply motion blur along the camera's motion."""
    length = min(float(np.hypot(*blur_px)), 12.0)
    if length < 1:
        return picture
    half = int(np.ceil(length / 2))
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    x, y = blur_px / np.hypot(*blur_px) * length / 2
    cv2.line(kernel, (round(half - x), round(half - y)), (round(half + x), round(half + y)), 1.0)
    return cv2.filter2D(picture, -1, kernel / kernel.sum())
