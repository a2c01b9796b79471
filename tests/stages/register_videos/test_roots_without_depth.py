"""Roots of recordings without measured depth: what the animal stands on, and which way it faces."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from pipeline.geometry import cameras, rigid
from pipeline.geometry.contact import StandingSurface
from pipeline.geometry.meshes import Mesh, RayCaster, render_view
from stages.register_videos import agent_roots
from stages.register_videos.config import RootConfig
from tests.stages.register_videos.test_agent_roots import animal

SIZE, DEPTH_SIZE = (192, 144), (96, 72)
INTRINSICS = np.array([[150.0, 0, 72], [0, 150.0, 96], [0, 0, 1]])
UP = np.array([0.0, 1.0, 0.0])
STAND_M, BOX_M = 0.22, 0.3
"""Height of the animal's root, and of the box in the map, meters."""
FRAMES = 12


class RenderedClip:
    """An animal in front of a plain wall; depth is the map's."""

    mapped = True

    def __init__(self, room: RayCaster, shown: Mesh, roots: np.ndarray, eyes: np.ndarray):
        self.timestamp_s = 0.1 * np.arange(len(roots))
        self.cameras = np.stack([rigid.look_at(eye, np.array([0.0, 0.2, 0.0]), UP) for eye in eyes])
        self.intrinsics = np.repeat(INTRINSICS[None], len(roots), 0)
        self.depth_intrinsics = cameras.scale_intrinsics(self.intrinsics, SIZE, DEPTH_SIZE)
        self._depth = [
            render_view(room, pose, self.depth_intrinsics[0], *DEPTH_SIZE)[0] for pose in self.cameras
        ]
        self._color, self.masks = [], MaskList()
        rng, caster = np.random.default_rng(0), RayCaster(shown)
        for root, camera in zip(roots, self.cameras, strict=True):
            depth, hits = render_view(caster, rigid.inverse(root) @ camera, INTRINSICS, *SIZE)
            shade = hits.interpolate(shown, shown.color).reshape(*SIZE, 3)
            color = np.where(depth[..., None] > 0, shade, [60, 160, 80]) + rng.normal(0, 6, (*SIZE, 3))
            self._color.append(np.clip(color, 0, 255).astype(np.uint8))
            self.masks.append(np.where(depth > 0, 255, 0).astype(np.uint8))

    def __len__(self) -> int:
        return len(self.timestamp_s)

    def color(self, frame: int) -> np.ndarray:
        return self._color[frame]

    def depth(self, frame: int) -> np.ndarray:
        return self._depth[frame]

    def confidence(self, frame: int) -> np.ndarray:
        return np.full(DEPTH_SIZE, 2, np.uint8)


class MaskList(list):
    """Masks of all frames."""

    @property
    def visible(self) -> np.ndarray:
        return np.ones(len(self), bool)


def mapped_room() -> RayCaster:
    """A floor with a box on it."""
    box = trimesh.creation.box((0.5, BOX_M, 0.9), rigid.make(np.eye(3), np.array([0.0, BOX_M / 2, 0.0])))
    floor = trimesh.creation.box((6, 0.02, 6), rigid.make(np.eye(3), np.array([0.0, -0.01, 0.0])))
    both = trimesh.util.concatenate([floor, box])
    return RayCaster(Mesh(np.asarray(both.vertices, np.float32), np.asarray(both.faces, np.int32)))


def found(roots: np.ndarray, shown: Mesh | None = None) -> np.ndarray:
    """Place the animal in a recording of ``roots``, of which ``shown`` is seen."""
    room, angle = mapped_room(), np.linspace(-0.2, 0.2, len(roots))
    eyes = np.stack([2.2 * np.cos(angle), 1.3 + 0 * angle, 2.2 * np.sin(angle)], -1)
    clip = RenderedClip(room, shown or animal(), roots, eyes)
    nothing = SimpleNamespace(localize=lambda *_: [])
    surface, rng = StandingSurface(room, 0.0), np.random.default_rng(0)
    return agent_roots.find_roots(
        clip, clip.masks, animal(), surface, nothing, clip.cameras, RootConfig(), rng
    ).world_from_agent


def standing(height_m: float, yaw_rad: float) -> np.ndarray:
    place = np.array([-0.1, STAND_M + height_m, 0.0])
    return np.repeat(rigid.make(rigid.rotation_from_vector(yaw_rad * UP), place)[None], FRAMES, 0)


@pytest.mark.parametrize("height_m", [0.0, BOX_M])
def test_floor_behind_a_moved_box_is_chosen_by_the_animals_size(height_m):
    """The map shows the box; the animal stands on it, or on the floor where the box was."""
    truth = standing(height_m, 0.3)
    off = np.linalg.norm(found(truth)[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert np.median(off) < 0.08, "meters; the other surface is about 0.4 away"


def test_sitting_animal_that_faces_the_camera_is_pitched_and_not_turned():
    """It is pitched by 30 degrees, so head and dark chest are seen, and neither back nor tail."""
    pitch = rigid.rotation_from_vector(np.array([-np.deg2rad(30), 0, 0]))
    truth = standing(0.0, np.pi / 2)
    truth = rigid.make(truth[:, :3, :3] @ pitch, truth[:, :3, 3])
    roots = found(truth)
    placed = np.isfinite(roots[:, 0, 0])
    turn = np.rad2deg(rigid.wrap(rigid.yaw(roots[placed]) - rigid.yaw(truth[placed])))
    assert placed.mean() > 0.8
    assert np.abs(turn).max() < 45, "degrees"
    tilt = np.rad2deg(np.arccos(np.clip(roots[placed, 1, 1], -1, 1)))
    assert tilt.min() > 8, "degrees, of 30; depth from the contact alone leaves it upright"
    off = np.linalg.norm(roots[placed, :3, 3] - truth[placed, :3, 3], axis=1)
    assert np.median(off) < 0.15, "meters; 0.22 by the contact alone, on which a standing animal fits"
