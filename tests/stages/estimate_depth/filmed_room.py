"""A textured room with its map, and plain videos of an animal in it, rendered with ground truth."""

from pathlib import Path

import numpy as np

from pipeline.data import images, ply
from pipeline.data.clips import FRAMES, PICTURES
from pipeline.data.templates import SceneCameras
from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import Mesh, RayCaster
from tests.stages import textured_room
from tests.stages.room_with_animal import animal

SIZE = (240, 180)
INTRINSICS = np.array([[178.0, 0, 90], [0, 178.0, 120], [0, 0, 1]])
ANIMAL_COLOR = np.array([235, 120, 30])


def render(
    room: RayCaster, camera: np.ndarray, world_from_agent: np.ndarray | None, rng: np.random.Generator
):
    """Return color, z-depth and the mask of the animal."""
    directions = cameras.ray_directions(INTRINSICS, *SIZE).reshape(-1, 3) @ camera[:3, :3].T
    hits = room.cast(camera[:3, 3], directions)
    distance, color = hits.distance, hits.interpolate(room.mesh, room.mesh.color)
    on_animal = np.zeros(len(directions), bool)
    if world_from_agent is not None:
        body = animal().apply_transform(world_from_agent)
        caster = RayCaster(Mesh(np.asarray(body.vertices, np.float32), np.asarray(body.faces)))
        nearest = caster.cast(camera[:3, 3], directions).distance
        on_animal = nearest < distance
        distance = np.minimum(distance, nearest)
    points = camera[:3, 3] + directions * distance[:, None]
    stripes = np.where(np.floor(points[:, :1] / 0.05) % 2, 40, -40)
    color = np.where(on_animal[:, None], ANIMAL_COLOR + stripes, color) + rng.normal(0, 2, color.shape)
    shape = (*SIZE, 3)
    return (
        np.clip(color, 0, 255).astype(np.uint8).reshape(shape),
        np.where(np.isfinite(distance), distance, 0).reshape(SIZE).astype(np.float32),
        on_animal.reshape(SIZE),
    )


def write_walk(folder: Path, room: Mesh, path: np.ndarray) -> None:
    """Write `frames` of a walk-through along a path."""
    rng, caster = np.random.default_rng(0), RayCaster(room)
    for name in ("color", "depth", "confidence"):
        (folder / name).mkdir(parents=True)
    for frame, camera in enumerate(path):
        color, depth, _ = render(caster, camera, None, rng)
        images.write_color(folder / f"color/{frame:06d}.jpg", color, 95)
        images.write_depth(folder / f"depth/{frame:06d}.exr", depth)
        images.write_gray(folder / f"confidence/{frame:06d}.png", np.full(SIZE, 2, np.uint8))
    each = np.ones(len(path), np.float32)
    intrinsics = np.repeat(INTRINSICS[None], len(path), axis=0)
    FRAMES.save(
        folder / "frames.npz", timestamp_s=np.arange(len(path)) * 0.1, intrinsics=intrinsics,
        depth_intrinsics=intrinsics, odometry_from_camera=path, gravity_known=np.array(True),
        scale=np.array("measured"), source_index=np.arange(len(path)), quarter_turns=np.array(0),
        sharpness=each, brightness=each, depth_valid=each, quality=each,
    )  # fmt: skip


def write_map(folder: Path, room: Mesh, path: np.ndarray) -> None:
    """Write the `scene_template` of a room and a walk-through."""
    folder.mkdir(parents=True)
    ply.write_ply(folder / "mesh.ply", room)
    (folder / "world.json").write_text('{"floor": 0.0}')
    intrinsics = np.repeat(INTRINSICS[None], len(path), axis=0)
    every = np.ones(len(path), bool)
    SceneCameras(np.arange(len(path)) * 0.1, path, intrinsics, every, every).write(folder)


def write_pictures(folder: Path, room: Mesh, path: np.ndarray, agent: np.ndarray):
    """Write `pictures` of a video; return true depth and masks."""
    rng, caster = np.random.default_rng(1), RayCaster(room)
    (folder / "color").mkdir(parents=True)
    truth = []
    for frame, (camera, pose) in enumerate(zip(path, agent, strict=True)):
        color, depth, mask = render(caster, camera, pose, rng)
        images.write_color(folder / f"color/{frame:06d}.jpg", color, 95)
        truth.append((depth, mask))
    each = np.ones(len(path), np.float32)
    PICTURES.save(
        folder / "pictures.npz", timestamp_s=np.arange(len(path)) * 0.1, source_index=np.arange(len(path)),
        quarter_turns=np.array(0), sharpness=each, brightness=each,
    )  # fmt: skip
    return tuple(map(np.stack, zip(*truth, strict=True)))


def room_and_walk():
    """Return the room and cameras of a walk-through."""
    return textured_room.textured_room(edge_m=0.03), textured_room.walk(30)


def session(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Cameras that follow an animal that walks along the floor."""
    along = np.linspace(-0.5, 0.6, count)
    agent = np.stack([rigid.exp(np.array([0, np.pi / 2, 0, x, 0.22, 0.1])) for x in along])
    eyes = np.stack([0.5 * along, 1.3 + 0.05 * np.sin(8 * along), 1.1 + 0.05 * np.cos(6 * along)], axis=1)
    targets = np.stack([0.8 * along, np.full(count, 0.35), np.full(count, -0.1)], axis=1)
    cameras_ = [rigid.look_at(eye, to, textured_room.UP) for eye, to in zip(eyes, targets, strict=True)]
    return np.stack(cameras_), agent


def circle(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Cameras on a circle around a resting animal."""
    angles = np.linspace(0, 1.2 * np.pi, count)
    middle = np.array([0.05, 0.25, 0.05])
    eyes = middle + np.stack([0.85 * np.cos(angles), 0.7 + 0 * angles, 0.85 * np.sin(angles)], axis=1)
    agent = rigid.exp(np.array([0, 0.6, 0, 0.05, 0.22, 0.05]))
    poses = np.stack([rigid.look_at(eye, middle, textured_room.UP) for eye in eyes])
    return poses, np.repeat(agent[None], count, axis=0)
