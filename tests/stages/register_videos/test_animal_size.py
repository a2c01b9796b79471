"""Animals whose size differs from the template are detected, independently of the pose of their legs."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import trimesh

from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh, RayCaster, render_view
from stages.register_videos.comparison import compare_sizes
from tests.stages.textured_room import INTRINSICS, SIZE, UP

FRAMES, WALL_M = 24, 4.0


def _body(swing: float = 0.0) -> Mesh:
    """A trunk on four legs that swing forward and back, and a head; 0.5 m long."""
    parts = [trimesh.creation.box((0.16, 0.16, 0.5))]
    parts += [trimesh.creation.box((0.12, 0.12, 0.14), rigid.make(np.eye(3), np.array([0, 0.12, 0.3])))]
    for side, end in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        at = np.array([0.06 * side, -0.16, 0.2 * end + swing * side * end])
        parts.append(trimesh.creation.box((0.04, 0.16, 0.04), rigid.make(np.eye(3), at)))
    whole = trimesh.util.concatenate(parts)
    return Mesh(whole.vertices.astype(np.float32), whole.faces.astype(np.int32))


@dataclass(frozen=True)
class Filmed:
    """A `Clip` and `Masks` of an animal in front of a wall."""

    seen: list[np.ndarray]
    """depth of the animal alone"""

    @property
    def depth_intrinsics(self) -> np.ndarray:
        return np.repeat(INTRINSICS[None], len(self.seen), axis=0)

    def depth(self, frame: int) -> np.ndarray:
        return np.where(self.seen[frame] > 0, self.seen[frame], WALL_M).astype(np.float32)

    def __getitem__(self, frame: int) -> np.ndarray:
        return np.where(self.seen[frame] > 0, 255, 0).astype(np.uint8)


def _compared(size: float, frames: int = FRAMES):
    """Render a walking animal scaled relative to the template, both with paws on the floor."""
    rng, root = np.random.default_rng(0), np.eye(4)
    eyes = [np.array([2 * np.sin(a), 0.8, 2 * np.cos(a)]) for a in rng.uniform(0, 2 * np.pi, frames)]
    cameras = np.stack([rigid.look_at(eye, np.zeros(3), UP) for eye in eyes])
    seen = []
    for camera in cameras:
        body = _body(0.06 * np.sin(rng.uniform(0, 6)))
        vertices = size * body.vertices
        vertices[:, 1] += _body().vertices[:, 1].min() - vertices[:, 1].min()
        caster = RayCaster(replace(body, vertices=vertices.astype(np.float32)))
        seen.append(render_view(caster, camera, INTRINSICS, *SIZE)[0])
    filmed = Filmed(seen)
    return compare_sizes(filmed, filmed, _body(), cameras, np.repeat(root[None], frames, axis=0))


@pytest.mark.parametrize("size", [0.97, 1.0, 1.03])
def test_animal_of_the_template_has_scale_one(size):
    found = _compared(size)
    assert found.better is None, found
    assert found.iou > 0.7


@pytest.mark.parametrize(("size", "better"), [(0.8, 0.8), (1.1, 1.1), (1.25, 1.25)])
def test_other_sizes_are_measured(size, better):
    found = _compared(size)
    assert found.better == better, found
    assert found.better_iou > found.iou


def test_animal_without_roots_has_no_size():
    nowhere = np.full((3, 4, 4), np.nan)
    found = compare_sizes(Filmed([]), Filmed([]), _body(), np.repeat(np.eye(4)[None], 3, axis=0), nowhere)
    assert found.frames == 0
    assert found.better is None
