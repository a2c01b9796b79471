"""A small furnished room with texture everywhere, and in-memory recordings with ground truth."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh

from pipeline.data import images
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh, RayCaster, render_view

SIZE = (160, 120)
INTRINSICS = np.array([[118.0, 0, 60], [0, 118.0, 80], [0, 0, 1]])
UP = np.array([0.0, 1.0, 0.0])


def textured_room(seed: int = 0, edge_m: float = 0.04) -> Mesh:
    """Room of 3 x 2.2 x 2.6 m, floor at 0, with three boxes; vertex colors are smooth noise at several
    scales.
    """
    walls = trimesh.creation.box((3.0, 2.2, 2.6), rigid.make(np.eye(3), np.array([0, 1.1, 0.0])))
    walls.invert()
    boxes = [
        ((0.6, 0.5, 0.9), (1.1, 0.25, 0.6)),
        ((0.4, 1.1, 0.4), (-1.2, 0.55, -0.9)),
        ((0.8, 0.35, 0.4), (-0.9, 0.17, 0.9)),
    ]
    parts = [walls, *(trimesh.creation.box(size, rigid.make(np.eye(3), np.array(at))) for size, at in boxes)]
    whole = trimesh.util.concatenate(parts)
    vertices, faces = trimesh.remesh.subdivide_to_size(whole.vertices, whole.faces, edge_m, max_iter=12)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), noise_color(vertices, seed))


def noise_color(points: np.ndarray, seed: int) -> np.ndarray:
    """Return colors of a sum of smooth random fields."""
    rng = np.random.default_rng(seed)
    color = np.full((len(points), 3), 128.0)
    for cell_m, strength in ((0.5, 60.0), (0.22, 55.0), (0.1, 45.0)):
        grid = rng.uniform(-1, 1, (40, 40, 40, 3))
        place = points / cell_m + 20
        low = np.floor(place).astype(int)
        part = place - low
        for corner in np.ndindex(2, 2, 2):
            share = np.prod(np.where(corner, part, 1 - part), axis=1)[:, None]
            color += strength * share * grid[tuple(((low + corner) % 40).T)]
    return np.clip(color, 0, 255).astype(np.uint8)


def walk(frames: int, seed: int = 0) -> np.ndarray:
    """Return cameras that move half around the room and look across it, downwards."""
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    poses = []
    for angle in phase + np.linspace(0, 1.1 * np.pi, frames):
        eye = np.array([0.9 * np.cos(angle), 1.4 + 0.1 * np.sin(2 * angle), 0.75 * np.sin(angle)])
        poses.append(rigid.look_at(eye, np.array([0.2 * np.sin(3 * angle), 0.55, 0.0]), UP))
    return np.stack(poses)


@dataclass(frozen=True)
class MemoryClip:
    """A `Clip` whose pictures are rendered on demand; `truth` is for tests only."""

    caster: RayCaster
    truth: np.ndarray
    odometry_from_camera: np.ndarray | None
    gravity_known: bool = True
    folder: Path = Path("memory")
    noise_m: float = 0.004
    color_size: tuple[int, int] = SIZE
    depth_size: tuple[int, int] = SIZE
    cache: dict = field(default_factory=dict)
    scale: str = "measured"
    mapped: bool = False

    def __len__(self) -> int:
        return len(self.truth)

    @property
    def timestamp_s(self) -> np.ndarray:
        return np.arange(len(self.truth)) * 0.1

    @property
    def quality(self) -> np.ndarray:
        return np.ones(len(self.truth))

    @property
    def intrinsics(self) -> np.ndarray:
        return np.repeat(INTRINSICS[None], len(self.truth), axis=0)

    depth_intrinsics = intrinsics

    def _render(self, frame: int):
        if frame not in self.cache:
            depth, hits = render_view(self.caster, self.truth[frame], INTRINSICS, *SIZE)
            color = hits.interpolate(self.caster.mesh, self.caster.mesh.color).reshape(*SIZE, 3)
            noise = np.random.default_rng(frame).normal(0, self.noise_m, SIZE)
            self.cache[frame] = (
                color.round().astype(np.uint8),
                np.where(depth > 0, depth + noise, 0).astype(np.float32),
            )
        return self.cache[frame]

    def color(self, frame: int) -> np.ndarray:
        return self._render(frame)[0]

    def depth(self, frame: int) -> np.ndarray:
        return self._render(frame)[1]

    def confidence(self, frame: int) -> np.ndarray:
        return np.full(SIZE, 2, np.uint8)

    def write_color(self, folder: Path) -> None:
        """Write the pictures to the folder that COLMAP reads."""
        (folder / "color").mkdir(parents=True)
        for frame in range(len(self)):
            images.write_color(folder / "color" / f"{frame:06d}.jpg", self.color(frame))


class NoAgent:
    """`Masks` of a recording without an animal."""

    def __init__(self, frames: int):
        self.visible = np.zeros(frames, bool)

    def __getitem__(self, frame: int) -> np.ndarray:
        return np.zeros(SIZE, np.uint8)


def drifting(truth: np.ndarray, seed: int, *, deg: float = 0.1, m: float = 0.004) -> np.ndarray:
    """Return odometry with its own origin and heading and random errors per step."""
    rng = np.random.default_rng(seed)
    start = rigid.make(rigid.rotation_from_vector(UP * rng.uniform(-3, 3)), rng.uniform(-1, 1, 3))
    steps = (
        rigid.inverse(truth[:-1])
        @ truth[1:]
        @ rigid.exp(rng.normal(0, 1, (len(truth) - 1, 6)) * ([np.deg2rad(deg)] * 3 + [m] * 3))
    )
    odometry = [start @ truth[0]]
    for step in steps:
        odometry.append(odometry[-1] @ step)
    return np.stack(odometry)


def aligned_errors(poses: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation errors in degrees and position errors in meters after rigid alignment of all poses."""
    rotation = rigid.mean_rotation(truth[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2))
    moved = rigid.make(rotation, (truth[:, :3, 3] - poses[:, :3, 3] @ rotation.T).mean(0)) @ poses
    angle = np.rad2deg(rigid.rotation_angle(moved[:, :3, :3], truth[:, :3, :3]))
    return angle, np.linalg.norm(moved[:, :3, 3] - truth[:, :3, 3], axis=1)
