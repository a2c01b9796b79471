"""A small rendered recording with ground truth: a furnished box-shaped room and a blocky animal, as a frames
artifact.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from pipeline.data import images, npz
from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import Mesh, RayCaster

COLOR_SIZE, DEPTH_SIZE = (120, 90), (120, 90)
INTRINSICS = np.array([[84.0, 0, 45], [0, 84.0, 60], [0, 0, 1]])
UP = np.array([0.0, 1.0, 0.0])
ROOM_COLOR = np.array([120, 130, 150])
ANIMAL_COLOR = np.array([190, 120, 50])
OTHER_COLOR = np.array([60, 160, 80])


def box(size, at) -> trimesh.Trimesh:
    return trimesh.creation.box(size, rigid.make(np.eye(3), np.array(at, float)))


def room() -> trimesh.Trimesh:
    """Room of 4 x 2.4 x 3.4 m, floor at 0, with three pieces of furniture."""
    walls = box((4, 2.4, 3.4), (0, 1.2, 0))
    walls.invert()
    furniture = [
        box((0.6, 0.5, 0.9), (1.5, 0.25, 0.9)),
        box((0.4, 1.1, 0.4), (-1.5, 0.55, -1.1)),
        box((0.8, 0.35, 0.4), (-1.2, 0.175, 1.2)),
    ]
    return trimesh.util.concatenate([walls, *furniture])


def animal() -> trimesh.Trimesh:
    """Overlapping boxes for body, head, tail and legs; root in the body, +y up, head towards +z, paws at
    -0.22.
    """
    parts = [
        box((0.14, 0.15, 0.4), (0, 0, 0)),
        box((0.12, 0.13, 0.14), (0, 0.12, 0.24)),
        box((0.03, 0.03, 0.2), (0, 0.06, -0.28)),
    ]
    parts += [box((0.05, 0.2, 0.05), (x, -0.12, z)) for x in (-0.05, 0.05) for z in (-0.16, 0.16)]
    return trimesh.util.concatenate(parts)


def person() -> trimesh.Trimesh:
    """Two legs, a body and a head, 1.7 m tall; the origin is between the feet."""
    legs = [box((0.15, 0.8, 0.18), (x, 0.4, 0)) for x in (-0.1, 0.1)]
    return trimesh.util.concatenate(
        [*legs, box((0.44, 0.6, 0.25), (0, 1.1, 0)), box((0.2, 0.3, 0.2), (0, 1.55, 0))]
    )


@dataclass(frozen=True)
class Recording:
    """The rendered recording."""

    world_from_camera: np.ndarray
    world_from_agent: np.ndarray
    masks: np.ndarray
    others: np.ndarray
    """masks of the other animal"""


def record(
    folder: Path,
    world_from_camera: np.ndarray,
    world_from_agent: np.ndarray,
    odometry: np.ndarray | None,
    seed: int = 0,
    world_from_other: np.ndarray | None = None,
    other_body: trimesh.Trimesh | None = None,
) -> Recording:
    """Render a frames artifact into ``folder``. NaN poses omit an animal; the other animal is green unless it
    has its own body.
    """
    rng = np.random.default_rng(seed)
    still, bodies = room(), (animal(), other_body or animal())
    others = np.full_like(world_from_agent, np.nan) if world_from_other is None else world_from_other
    for name in ("color", "depth", "confidence"):
        (folder / name).mkdir(parents=True)
    masks = []
    for frame, (camera, agent, other) in enumerate(
        zip(world_from_camera, world_from_agent, others, strict=True)
    ):
        movers = [(pose, kind) for pose, kind in ((agent, 1), (other, 2)) if not np.isnan(pose).any()]
        moved = [bodies[kind - 1].copy().apply_transform(pose) for pose, kind in movers]
        mesh = trimesh.util.concatenate([still, *moved])
        kinds = np.repeat(
            [0, *(kind for _, kind in movers), 0], [len(still.faces), *(len(each.faces) for each in moved), 1]
        )
        directions = cameras.ray_directions(INTRINSICS, *COLOR_SIZE).reshape(-1, 3) @ camera[:3, :3].T
        hits = RayCaster(Mesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces))).cast(
            camera[:3, 3], directions
        )
        kind = kinds[hits.face]
        points = camera[:3, 3] + directions * hits.distance[:, None]
        check = np.where(np.floor(points / 0.17 + 0.013).astype(int).sum(1) % 2, 25, -25)[:, None]
        color = np.choose(kind[:, None], [ROOM_COLOR + check, ANIMAL_COLOR, OTHER_COLOR]) + rng.normal(
            0, 4, (len(points), 3)
        )
        depth = hits.distance + rng.normal(0, 0.005, len(points))
        images.write_color(
            folder / "color" / f"{frame:06d}.jpg",
            np.clip(color, 0, 255).astype(np.uint8).reshape(*COLOR_SIZE, 3),
        )
        images.write_depth(folder / "depth" / f"{frame:06d}.exr", depth.reshape(DEPTH_SIZE))
        images.write_gray(folder / "confidence" / f"{frame:06d}.png", np.full(DEPTH_SIZE, 2, np.uint8))
        masks.append(kind.reshape(COLOR_SIZE))
    count = len(world_from_camera)
    table = {"odometry_from_camera": odometry} if odometry is not None else {}
    npz.save(
        folder / "frames.npz",
        timestamp_s=np.arange(count) * 0.1,
        intrinsics=np.repeat(INTRINSICS[None], count, 0),
        depth_intrinsics=np.repeat(INTRINSICS[None], count, 0),
        gravity_known=np.array(True),
        quality=np.ones(count, np.float32),
        **table,
    )
    shown = np.stack(masks)
    return Recording(world_from_camera, world_from_agent, shown == 1, shown == 2)


def drifted(world_from_camera: np.ndarray, seed: int = 1) -> np.ndarray:
    """Odometry with its own origin and heading and a drift of 2 mm and 0.05 degrees per frame."""
    rng = np.random.default_rng(seed)
    relative = rigid.inverse(world_from_camera[:-1]) @ world_from_camera[1:]
    noise = rigid.exp(rng.normal(0, [0.0009] * 3 + [0.002] * 3, (len(relative), 6)))
    found = [rigid.exp(np.array([0, 1.1, 0, 0.4, 0.2, -0.7])) @ world_from_camera[0]]
    for step, wrong in zip(relative, noise, strict=True):
        found.append(found[-1] @ step @ wrong)
    return np.stack(found)


def turnaround(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Camera and agent poses of a full circle around the standing animal."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    middle = np.array([0.1, 0.2, -0.1])
    eyes = middle + np.stack(
        [0.95 * np.cos(angles), 0.55 + 0.1 * np.sin(2 * angles), 0.95 * np.sin(angles)], axis=1
    )
    poses = np.stack([rigid.look_at(eye, middle, UP) for eye in eyes])
    agent = rigid.exp(np.array([0, 0.6, 0, 0.1, 0.22, -0.1]))
    return poses, np.repeat(agent[None], count, 0)


def session(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """The animal walks, rests in the middle half, walks on, and is absent in the last frames; the camera
    sways and follows.
    """
    time = np.linspace(0, 1, count)
    along = np.interp(time, [0, 0.25, 0.75, 0.95], [-0.7, 0.0, 0.0, 0.7])
    agent = np.stack([rigid.exp(np.array([0, np.pi / 2, 0, x, 0.22, -0.2])) for x in along])
    agent[-3:] = np.nan
    eyes = np.stack(
        [0.3 * np.sin(3 * time), 1.1 + 0.05 * np.cos(9 * time), 1.3 + 0.1 * np.sin(5 * time)], axis=1
    )
    poses = np.stack(
        [rigid.look_at(eye, np.array([0.4 * x, 0.2, -0.2]), UP) for eye, x in zip(eyes, along, strict=True)]
    )
    return poses, agent
