"""Refinement of Gaussians on walls filmed in two videos with different light, with objects that differ
between videos.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipeline.data.motion import Motion
from pipeline.fields import gaussians
from pipeline.fields.fields import Field, FieldShape
from pipeline.fields.fused_depth import NODES, FusedGeometry
from pipeline.geometry.meshes import Mesh
from stages.refine_gaussians import cover
from stages.refine_gaussians.views import DrawnVideo

SIZE, FOCAL, WALL_M = (120, 160), 80.0, 1.5
LIGHT = (1.0, 0.7)
FRAMES = 8
EVERYWHERE, SHARED = np.ones((3, 8000), bool), np.full(8000, -1)


def paint(points: np.ndarray) -> np.ndarray:
    """Gray for x < 0, elsewhere red and blue squares of 10 cm."""
    checked = (np.floor(points[:, 0] / 0.1) + np.floor(points[:, 1] / 0.1)) % 2
    squares = np.where(checked[:, None], [0.9, 0.2, 0.2], [0.2, 0.2, 0.9])
    return np.where(points[:, :1] < 0, 0.5, squares)


def film(video: int) -> DrawnVideo:
    """Render the wall from the front with small camera motion."""
    intrinsics = np.array([[FOCAL, 0, 80], [0, FOCAL, 60], [0, 0, 1]])
    camera = np.tile(np.eye(4), (4, 1, 1))
    camera[:, 0, 3] = np.linspace(-0.1, 0.1, 4)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5

    def color(frame: int) -> np.ndarray:
        place = np.stack(
            [(x - 80) / FOCAL * WALL_M + camera[frame, 0, 3], (y - 60) / FOCAL * WALL_M], axis=-1
        ).reshape(-1, 2)
        return np.rint(255 * LIGHT[video] * paint(place)).astype(np.uint8).reshape(*SIZE, 3)

    clip = SimpleNamespace(
        color=color, depth=lambda _: np.full((60, 80), WALL_M), confidence=lambda _: np.full((60, 80), 2),
        intrinsics=np.tile(intrinsics, (4, 1, 1)), color_size=SIZE,
    )  # fmt: skip
    motion = Motion(
        np.arange(4.0),
        camera,
        np.full((4, 4, 4), np.nan),
        np.zeros((4, 1, 4, 4)),
        np.ones(4),
        np.zeros(4, bool),
    )
    return DrawnVideo(f"v{video}", clip, None, None, motion, 4 * video, video)


@pytest.fixture(scope="module")
def wall() -> gaussians.SurfaceSamples:
    """The reconstructed wall: colors blurred to the mean of each side, and a back-facing second layer."""
    vertices = np.array(
        [[x, y, WALL_M + z] for z in (0, 0.02) for x in (-1.4, 0, 1.4) for y in (-1, 1)], np.float32
    )
    front = np.array([[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5]])
    dark = np.where(vertices[:, :1] < 0, 128, [140, 51, 140]).astype(np.uint8)
    return gaussians.sample_surface(
        Mesh(vertices, np.concatenate([front, front[:, ::-1] + 6]), dark), 8000, np.random.default_rng(0)
    )


def test_color_and_light_are_recovered(wall):
    seen = cover.observe(wall, EVERYWHERE, [film(0), film(1)], FRAMES)
    shown = seen.weight > 0
    assert not shown[wall.points[:, 2] > WALL_M + 0.01].any(), "what faces away is not seen"
    assert (
        shown[(np.abs(wall.points[:, :2]) < [1.2, 0.9]).all(1) & (wall.points[:, 2] < WALL_M + 0.01)].mean()
        > 0.99
    )
    bright, dark = (matrix[:, :3] @ np.full(3, 0.5) + matrix[:, 3] for matrix in seen.appearance)
    np.testing.assert_allclose(dark / bright, LIGHT[1] / LIGHT[0], atol=0.04)
    found = seen.color[shown] @ seen.appearance[0][:, :3].T + seen.appearance[0][:, 3]
    assert np.median(np.abs(found - paint(wall.points[shown]))) < 0.04, (
        "the squares, which the mesh does not know"
    )


def test_surfaces_in_observed_free_space_are_removed(wall):
    """All pictures see through the second layer, half a meter in front of the wall."""
    ghost = wall.points[:, 2] > WALL_M + 0.01
    points = wall.points - ghost[:, None] * np.array([0, 0, 0.5])
    seen = cover.observe(replace(wall, points=points), EVERYWHERE, [film(0), film(1)], FRAMES)
    kept, _ = cover.subsample(points, SHARED, seen, 2000, np.random.default_rng(0))
    in_view = (np.abs(points[:, :2]) < [0.7, 0.5]).all(1)
    assert (
        (in_view & ghost).sum() > 300 and not (in_view & ghost)[kept].any() and (in_view & ~ghost)[kept].any()
    )


def test_gaussians_concentrate_at_color_edges(wall, monkeypatch):
    monkeypatch.setattr(cover, "BASE_GRADIENT", 0.01)
    monkeypatch.setattr(cover, "UNIFORM_SHARE", 0.1)
    seen = cover.observe(wall, EVERYWHERE, [film(0), film(1)], FRAMES)
    kept, spacing_m = cover.subsample(wall.points, SHARED, seen, 2000, np.random.default_rng(0))
    assert abs(len(kept) - 2000) < 40
    points = wall.points[kept]
    middle = (np.abs(points[:, :2]) < [1.0, 0.7]).all(1) & (points[:, 2] < WALL_M + 0.01)
    plain, checked = (middle & (sign * points[:, 0] > 0.1) for sign in (-1, 1))
    assert checked.sum() > 4 * plain.sum() > 0 and spacing_m[checked].mean() < 0.6 * spacing_m[plain].mean()


def board(height_cells: float | None) -> torch.Tensor:
    """Return a block of the volume with a horizontal surface (None: empty)."""
    block = torch.ones(NODES, NODES, NODES, 5)
    if height_cells is not None:
        block[..., 0] = ((torch.arange(NODES) - height_cells) / 2).clamp(-1, 1)[None, :, None]
    return block


def test_moved_objects_are_separate_per_video():
    """Four blocks: the floor is shared in the first; video 0 has a board in the second, video 1 a board and
    no floor in the third.
    """
    table = torch.tensor([[1, 2, 0, 0], [3, 0, 2, 0], [1, 0, 0, 0]], dtype=torch.int32)[:, :, None, None]
    blocks = torch.stack([board(None), board(4.5), board(2.5), board(None)]).half()
    shape = FieldShape(
        low_m=(0, 0, 0), high_m=(1.28, 0.32, 0.32), voxel_m=(0.16,), videos=2, truncation_m=0.08
    )
    field = Field(shape, 0.1, FusedGeometry(torch.zeros(3), 0.04, 0.08, table, blocks)).requires_grad_(False)
    points, layer, stands = cover.sample_surfaces(field, [0, 1], 300, np.random.default_rng(0))
    block = (points.points[:, 0] // 0.32).astype(int)
    assert [np.unique(block[layer == one]).tolist() for one in (-1, 0, 1)] == [[0], [1], [2]]
    np.testing.assert_array_equal(stands, [layer <= 0, layer == 1, layer == -1])
    np.testing.assert_allclose(points.points[layer >= 0, 1], 0.10, atol=0.003)
