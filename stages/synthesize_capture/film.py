"""Film a script: render each frame, apply the sensor model, and keep its ground truth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.geometry import cameras, rigid
from stages.synthesize_capture import animal, light, raster, sensor, shade
from stages.synthesize_capture.animal import INDEX, Animal
from stages.synthesize_capture.script import Script
from stages.synthesize_capture.visitor import PERSON

VISITOR_CELL_M, FLOW_PX = 0.006, 4
"""Grid spacing of the visitor's surface, before scaling, and of true flow in the picture."""


@dataclass(frozen=True)
class Frame:
    """One recorded frame and its ground truth, all in the stored orientation."""

    color: UInt8[np.ndarray, "height width 3"]
    depth: Float[np.ndarray, "rows columns"]
    confidence: UInt8[np.ndarray, "rows columns"]
    true_depth: Float[np.ndarray, "rows columns"]
    masks: Bool[np.ndarray, "body height width"]
    """Masks of the animal, the companion and a visitor."""
    vertices_world: Sequence[Float[np.ndarray, "vertex 3"] | None]


@dataclass(frozen=True)
class Body:
    """One animal, or the visitor, in one frame."""

    creature: Animal
    world_from_bone: Float[np.ndarray, "bone 4 4"]
    vertices_world: Float[np.ndarray, "vertex 3"]
    number: int
    """0: animal, 1: companion, 2: visitor."""


class Stage:
    """The lit scene of one script: the room's textured mesh, and the animals."""

    def __init__(self, script: Script, creature: Animal, companion: Animal | None = None):
        dressing, visited = np.random.default_rng([script.seed, 8]), script.motions[2] is not None
        visitor = animal.embody(PERSON, dressing, VISITOR_CELL_M) if visited else None
        self.script, self.creatures = script, (creature, companion, visitor)
        self._rng = np.random.default_rng([script.seed, 7])
        lit = light.lit_sheets(script.room, script.light, self._rng)
        self.room = shade.backdrop(script.room.sheets(), lit)

    def bodies(self, index: int) -> list[Body]:
        """Return the bodies present in a frame, ordered by number."""
        found = []
        for number, (creature, motion) in enumerate(zip(self.creatures, self.script.motions, strict=True)):
            if creature is not None and motion is not None:
                bones = motion.world_from_agent[index] @ motion.agent_from_bone[index]
                found.append(Body(creature, bones, animal.surface(creature, bones), number))
        return found

    def mesh(self, bodies: Sequence[Body]) -> tuple[Float[np.ndarray, "joined 3"], Int[np.ndarray, "face 3"]]:
        """Return vertices (world, meters) and faces of the room, then of the animals."""
        vertices = np.concatenate([self.room.vertices, *(body.vertices_world for body in bodies)])
        return vertices, np.concatenate([self.room.faces, *_faces(bodies, start=len(self.room.vertices))])

    def frames(self) -> Iterator[Frame]:
        """Film every frame in order."""
        script = self.script
        focal_px, shutter_s = float(script.intrinsics[0, 0]), script.exposure.shutter_s
        blur = sensor.motion_blur_px(script.world_from_camera, script.timestamp_s, focal_px, shutter_s)
        for index in range(len(script.timestamp_s)):
            yield self._frame(index, blur[index])

    def _frame(self, index: int, blur_px: np.ndarray) -> Frame:
        script = self.script
        (height, width), (rows, columns) = script.phone.color_size, script.phone.depth_size
        camera_from_world = rigid.inverse(script.world_from_camera[index])
        bodies = self.bodies(index)
        vertices, faces = self.mesh(bodies)
        fx, fy, cx, cy = focal = script.intrinsics[index]
        doubled = np.array([[2 * fx, 0, 2 * cx], [0, 2 * fy, 2 * cy], [0, 0, 1]])
        points_camera = rigid.apply(camera_from_world, vertices)
        view = raster.rasterize(points_camera, faces, doubled, 2 * height, 2 * width)
        coat = self._coat(bodies, camera_from_world)
        linear = shade.shade(view.face, view.inverse_corners, focal, self.room, coat, camera_from_world)
        color = sensor.picture(linear, script.exposure, float(script.gain[index]), blur_px, self._rng)
        smaller = np.array(
            [fx * columns / width, fy * rows / height, cx * columns / width, cy * rows / height]
        )
        true_depth = raster.depth_through(
            view.face, view.inverse_depth, view.inverse_corners, smaller, rows, columns
        )
        depth, confidence = sensor.lidar(true_depth, self._rng)
        masks, start = np.zeros((3, height, width), bool), len(self.room.faces)
        shown: list[np.ndarray | None] = [None] * 3
        for body in bodies:
            stop = start + len(body.creature.faces)
            masks[body.number] = _four_sums((view.face >= start) & (view.face < stop)) >= 2
            shown[body.number], start = body.vertices_world, stop
        return Frame(color, depth, confidence, true_depth, masks, shown)

    def _coat(self, bodies: Sequence[Body], camera_from_world: np.ndarray) -> shade.Coat:
        received, balls = [np.zeros((0, 3), np.float32)], []
        for body in bodies:
            anatomy, points = body.creature.anatomy, body.vertices_world
            normals = animal.normals_of(points, body.creature.faces)
            received.append(light.light_on_body(points, normals, self.script.room, self.script.light))
            camera_from_bone = camera_from_world @ body.world_from_bone
            for bone, rest, radius in anatomy.balls():
                local = anatomy.size * (np.asarray(rest) - anatomy.heads[INDEX[bone]])
                middle = rigid.apply(camera_from_bone[INDEX[bone]], local[None])[0]
                balls.append([*middle, anatomy.size * radius])
        return shade.Coat(
            np.concatenate([np.zeros((0, 3), np.int32), *_faces(bodies, start=0)]),
            np.concatenate([received[0], *(body.creature.vertices for body in bodies)]),
            np.concatenate(received),
            np.concatenate([np.zeros((0, 4), np.float32), *(body.creature.fur for body in bodies)]),
            np.array(balls).reshape(-1, 4),
        )


def _faces(bodies: Sequence[Body], start: int) -> Iterator[Int[np.ndarray, "face 3"]]:
    """Return the faces of bodies whose vertices are concatenated from index ``start``."""
    for body in bodies:
        yield body.creature.faces + np.int32(start)
        start += len(body.vertices_world)


def true_flow(stage: Stage, first: int, second: int) -> Float[np.ndarray, "rows columns 2"]:
    """Return flow between two frames of the upright picture, pixels, at the centers of cells of `FLOW_PX`.

    NaN where the surface is hidden or out of view in frame ``second``.
    """
    script, size = stage.script, stage.script.phone.color_size
    pair, turns = [first, second], stage.script.quarter_turns
    upright_from_world = rigid.inverse(cameras.turn_camera(script.world_from_camera[pair], turns))
    lenses = cameras.turn_intrinsics(matrices(script.intrinsics[pair]), size, turns)
    height, width = size if turns % 2 == 0 else size[::-1]
    here, there = (stage.mesh(stage.bodies(index)) for index in pair)
    cells = (height // FLOW_PX, width // FLOW_PX)
    coarse = cameras.scale_intrinsics(lenses[0], (height, width), cells)
    view = raster.rasterize(rigid.apply(upright_from_world[0], here[0]), here[1], coarse, *cells)
    rays = cameras.ray_directions(coarse, *cells)
    share = np.einsum("hwij,hwj->hwi", view.inverse_corners[np.maximum(view.face, 0)], rays)
    share /= np.maximum(share.sum(-1, keepdims=True), 1e-9)
    corners = there[0][there[1][np.maximum(view.face, 0)]]
    moved = rigid.apply(upright_from_world[1], np.einsum("hwi,hwij->hwj", share, corners).reshape(-1, 3))
    pixel, depth = cameras.project(moved.reshape(*cells, 3), lenses[1])
    flow = (pixel - (cameras.pixel_grid(*cells) * FLOW_PX)).astype(np.float32)
    inside = cameras.in_picture(pixel, depth, (height, width), 0.05) & (view.face >= 0)
    seen = raster.rasterize(rigid.apply(upright_from_world[1], there[0]), there[1], lenses[1], height, width)
    nearest = cameras.sample_nearest(seen.inverse_depth, pixel)
    hidden = depth > 1.0 / np.maximum(nearest, 1e-3) + 0.02 + 0.01 * depth
    flow[~inside | hidden] = np.nan
    return flow


def matrices(intrinsics: Float[np.ndarray, "frame 4"]) -> Float[np.ndarray, "frame 3 3"]:
    """Convert rows of fx, fy, cx, cy to matrices."""
    out = np.zeros((len(intrinsics), 3, 3))
    out[:, 0, 0], out[:, 1, 1], out[:, 0, 2], out[:, 1, 2], out[:, 2, 2] = *intrinsics.T, 1.0
    return out


def _four_sums(flags: Bool[np.ndarray, "rows columns"]) -> UInt8[np.ndarray, "height width"]:
    """Count the flags in each 2 x 2 block."""
    counts = flags.view(np.uint8)
    return counts[::2, ::2] + counts[1::2, ::2] + counts[::2, 1::2] + counts[1::2, 1::2]
