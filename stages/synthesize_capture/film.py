"""Film a script: render each frame, pass it through the sensor, and keep what is true beside what is
recorded.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.geometry import cameras, rigid
from stages.synthesize_capture import animal, light, raster, sensor, shade
from stages.synthesize_capture.animal import INDEX, Animal
from stages.synthesize_capture.script import Script


@dataclass(frozen=True)
class Frame:
    """One recorded frame and its truth, all on the stored canvas."""

    color: UInt8[np.ndarray, "height width 3"]
    depth: Float[np.ndarray, "rows columns"]
    confidence: UInt8[np.ndarray, "rows columns"]
    true_depth: Float[np.ndarray, "rows columns"]
    mask: Bool[np.ndarray, "height width"]
    vertices_world: Float[np.ndarray, "vertex 3"] | None
    companion_mask: Bool[np.ndarray, "height width"]
    companion_vertices_world: Float[np.ndarray, "vertex 3"] | None


@dataclass(frozen=True)
class Body:
    """One animal in one frame."""

    creature: Animal
    world_from_bone: Float[np.ndarray, "bone 4 4"]
    vertices_world: Float[np.ndarray, "vertex 3"]
    second: bool
    """Whether it is the companion."""


class Stage:
    """The lit set of one script: the room's mesh with its pictures, and the animals."""

    def __init__(self, script: Script, creature: Animal, companion: Animal | None = None):
        self.script, self.creature, self.companion = script, creature, companion
        self._rng = np.random.default_rng([script.seed, 7])
        lit = light.lit_sheets(script.room, script.light, self._rng)
        self.room = shade.backdrop(script.room.sheets(), lit)
        self.empty = creature.faces[:0]

    def bodies(self, index: int) -> list[Body]:
        """Return the animals that are there in a frame, the companion last."""
        script, found = self.script, []
        for creature, motion, second in (
            (self.creature, script.motion, False),
            (self.companion, script.companion_motion, True),
        ):
            if creature is not None and motion is not None:
                world_from_bone = motion.world_from_agent[index] @ motion.agent_from_bone[index]
                found.append(
                    Body(creature, world_from_bone, animal.surface(creature, world_from_bone), second)
                )
        return found

    def mesh(self, bodies: Sequence[Body]) -> tuple[Float[np.ndarray, "joined 3"], Int[np.ndarray, "face 3"]]:
        """Return vertices (world, metres) and faces of room and animals together; the animals' faces come
        last.
        """
        if not bodies:
            return self.room.vertices, self.room.faces
        vertices = np.concatenate([self.room.vertices, *(body.vertices_world for body in bodies)])
        return vertices, np.concatenate(
            [self.room.faces, _joined_faces(bodies, start=len(self.room.vertices))]
        )

    def frames(self) -> Iterator[Frame]:
        """Film every frame in order."""
        script = self.script
        blur = sensor.motion_blur_px(
            script.world_from_camera,
            script.timestamp_s,
            float(script.intrinsics[0, 0]),
            script.exposure.shutter_s,
        )
        for index in range(len(script.timestamp_s)):
            yield self._frame(index, blur[index])

    def _frame(self, index: int, blur_px: np.ndarray) -> Frame:
        script = self.script
        (height, width), (rows, columns) = script.color_size, script.depth_size
        camera_from_world = rigid.inverse(script.world_from_camera[index])
        bodies = self.bodies(index)
        vertices, faces = self.mesh(bodies)
        fx, fy, cx, cy = script.intrinsics[index]
        doubled = np.array([[2 * fx, 0, 2 * cx], [0, 2 * fy, 2 * cy], [0, 0, 1]])
        view = raster.see(rigid.apply(camera_from_world, vertices), faces, doubled, 2 * height, 2 * width)
        coat = self._coat(bodies, camera_from_world)
        linear = shade.shade(
            view.face, view.inverse_corners, (fx, fy, cx, cy), self.room, coat, camera_from_world
        )
        color = sensor.picture(linear, script.exposure, float(script.gain[index]), blur_px, self._rng)
        scaled = np.array(
            [fx * columns / width, fy * rows / height, cx * columns / width, cy * rows / height]
        )
        true_depth = raster.depth_through(
            view.face, view.inverse_depth, view.inverse_corners, scaled, rows, columns
        )
        depth, confidence = sensor.lidar(true_depth, self._rng)
        masks = [np.zeros((height, width), bool) for _ in range(2)]
        shown: list[np.ndarray | None] = [None, None]
        start = len(self.room.faces)
        for body in bodies:
            stop = start + len(body.creature.faces)
            masks[body.second] = _four_sums((view.face >= start) & (view.face < stop)) >= 2
            shown[body.second], start = body.vertices_world, stop
        return Frame(color, depth, confidence, true_depth, masks[0], shown[0], masks[1], shown[1])

    def _coat(self, bodies: Sequence[Body], camera_from_world: np.ndarray) -> shade.Coat:
        if not bodies:
            return shade.Coat(
                self.empty,
                np.zeros((0, 3), np.float32),
                np.zeros((0, 3), np.float32),
                np.zeros((0, 4), np.float32),
                np.zeros((0, 4)),
            )
        received, balls = [], []
        for body in bodies:
            creature, points = body.creature, body.vertices_world
            normals = animal.normals_of(points, creature.faces)
            received.append(light.light_on_body(points, normals, self.script.room, self.script.light))
            camera_from_bone = camera_from_world @ body.world_from_bone
            anatomy = creature.anatomy
            for bone, rest, radius in anatomy.balls():
                local = anatomy.size * (np.asarray(rest) - anatomy.heads[INDEX[bone]])
                middle = rigid.apply(camera_from_bone[INDEX[bone]], local[None])[0]
                balls.append([*middle, anatomy.size * radius])
        return shade.Coat(
            _joined_faces(bodies, start=0),
            np.concatenate([body.creature.vertices for body in bodies]),
            np.concatenate(received),
            np.concatenate([body.creature.fur for body in bodies]),
            np.array(balls),
        )


def _joined_faces(bodies: Sequence[Body], start: int) -> Int[np.ndarray, "face 3"]:
    """Return the faces of bodies whose vertices follow one another from number ``start`` on."""
    found = []
    for body in bodies:
        found.append(body.creature.faces + np.int32(start))
        start += len(body.vertices_world)
    return np.concatenate(found)


def true_flow(
    stage: Stage, first: int, second: int, *, stride: int = 4
) -> Float[np.ndarray, "rows columns 2"]:
    """Return flow between two frames of the upright picture, pixels, at the centres of ``stride``-pixel
    cells.

    NaN where the surface is hidden or out of view in frame ``second``.
    """
    script = stage.script
    upright = cameras.turn_camera(script.world_from_camera[[first, second]], script.quarter_turns)
    lenses = cameras.turn_intrinsics(
        matrices(script.intrinsics[[first, second]]), script.color_size, script.quarter_turns
    )
    height, width = script.color_size if script.quarter_turns % 2 == 0 else script.color_size[::-1]
    here, there = (stage.mesh(stage.bodies(index)) for index in (first, second))
    cells = (height // stride, width // stride)
    coarse = cameras.scale_intrinsics(lenses[0], (height, width), cells)
    view = raster.see(rigid.apply(rigid.inverse(upright[0]), here[0]), here[1], coarse, *cells)
    rays = cameras.ray_directions(coarse, *cells)
    share = np.einsum("hwij,hwj->hwi", view.inverse_corners[np.maximum(view.face, 0)], rays)
    share /= np.maximum(share.sum(-1, keepdims=True), 1e-9)
    corners = there[0][there[1][np.maximum(view.face, 0)]]
    moved = rigid.apply(
        rigid.inverse(upright[1]), np.einsum("hwi,hwij->hwj", share, corners).reshape(-1, 3)
    ).reshape(*cells, 3)
    pixel, depth = cameras.project(moved, lenses[1])
    flow = (pixel - (cameras.pixel_grid(*cells) * stride)).astype(np.float32)
    inside = (
        (depth > 0.05)
        & (pixel[..., 0] >= 0)
        & (pixel[..., 0] < width)
        & (pixel[..., 1] >= 0)
        & (pixel[..., 1] < height)
        & (view.face >= 0)
    )
    nearest = raster.see(
        rigid.apply(rigid.inverse(upright[1]), there[0]), there[1], lenses[1], height, width
    ).inverse_depth
    at = np.clip(np.nan_to_num(pixel), 0, [width - 1, height - 1]).astype(int)
    hidden = depth > 1.0 / np.maximum(nearest[at[..., 1], at[..., 0]], 1e-3) + 0.02 + 0.01 * depth
    flow[~inside | hidden] = np.nan
    return flow


def matrices(intrinsics: Float[np.ndarray, "frame 4"]) -> Float[np.ndarray, "frame 3 3"]:
    """Turn rows of fx, fy, cx, cy into matrices."""
    out = np.zeros((len(intrinsics), 3, 3))
    out[:, 0, 0], out[:, 1, 1], out[:, 0, 2], out[:, 1, 2], out[:, 2, 2] = *intrinsics.T, 1.0
    return out


def _four_sums(flags: Bool[np.ndarray, "rows columns"]) -> UInt8[np.ndarray, "height width"]:
    """Count the flags in each two by two block."""
    counts = flags.view(np.uint8)
    return counts[::2, ::2] + counts[1::2, ::2] + counts[::2, 1::2] + counts[1::2, 1::2]
