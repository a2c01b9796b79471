"""Properties of losses, volume rendering and gap filling."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipeline.data.motion import MotionTable, gaps_s
from pipeline.fields.fields import Field, FieldShape, density
from pipeline.fields.marching_cubes import zero_level
from pipeline.fields.render import Layer, composite
from pipeline.geometry import rigid
from stages.reconstruct import losses, results, scene
from stages.reconstruct.config import RayBatches
from stages.reconstruct.rays import Rays


def layer(value: torch.Tensor, color: tuple[float, float, float]) -> Layer:
    tint = torch.tensor(color, dtype=torch.float32).expand(*value.shape, 3)
    return Layer(value, tint, torch.zeros(*value.shape, 16))


def test_composite_shows_the_front_surface():
    depth = torch.linspace(0.1, 3, 300).expand(2, -1)
    wall = layer(density(2.0 - depth, torch.tensor(0.005)), (0.0, 0.0, 1.0))
    agent_at = torch.tensor([[1.0], [9.0]])  # in front of the wall on the first ray, nowhere on the second
    agent = layer(density((depth - agent_at).abs() - 0.1, torch.tensor(0.005)), (1.0, 0.0, 0.0))
    seen = composite(depth, torch.ones(2), wall, agent)
    torch.testing.assert_close(seen.agent, torch.tensor([1.0, 0.0]), atol=0.01, rtol=0)
    torch.testing.assert_close(seen.depth, torch.tensor([0.9, 2.0]), atol=0.03, rtol=0)
    assert seen.color[0, 0] > 0.98 and seen.color[1, 2] > 0.98
    assert (seen.opacity > 0.99).all()


def test_composite_mixes_by_density():
    depth = torch.linspace(0, 1, 50)[None]
    seen = composite(
        depth,
        torch.ones(1),
        layer(torch.full((1, 50), 3.0), (0, 0, 1)),
        layer(torch.full((1, 50), 1.0), (1, 0, 0)),
    )
    torch.testing.assert_close(seen.color[0, 0] / seen.color[0, 2], torch.tensor(1 / 3))


def test_long_free_space_is_transparent():
    """Fused distances saturate 6 cm in front of a wall at 4 m."""
    depth = torch.linspace(0.1, 4.5, 800)[None]
    distance, beta_m = (4.0 - depth).clamp(-0.06, 0.06), torch.tensor(0.02)
    clear, fog = (density(distance, beta_m, truncation_m) for truncation_m in (0.06, None))
    seen, veiled = (composite(depth, torch.ones(1), layer(each, (0, 0, 1))) for each in (clear, fog))
    torch.testing.assert_close(seen.depth, torch.tensor([4.0]), atol=0.02, rtol=0)
    assert seen.opacity > 0.99 and veiled.depth < 2, "meters"


def test_surfaces_are_found_where_no_depth_was_measured():
    depth, none = torch.tensor([0.0, 1.2, 0.0, 0.0]), torch.zeros(4)
    rays = Rays(
        none.long(), torch.tensor([[0.0, 0.0, 1.0]]).expand(4, 3), depth, none + 1, none[:, None].byte().expand(4, 3),
        none[:, None].to(torch.int8).expand(4, 16), none.byte(), none[:, None].expand(4, 2), none.byte(), none.to(torch.int8),
    )  # fmt: skip
    wall_m = torch.tensor([2.0, 9.0, 3.1, 9.0])

    def density_of(index: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
        distance = ((depth - wall_m[index, None]).abs() - 0.06).clamp(-0.06, 0.06)
        return density(distance, torch.tensor(0.007), 0.06)

    found = scene.surface_depths(rays, 5.0, density_of, torch.Generator().manual_seed(0))
    torch.testing.assert_close(found[[1, 3]], torch.tensor([1.2, 5.0]))
    torch.testing.assert_close(found[[0, 2]], wall_m[[0, 2]], atol=scene.REACH_M, rtol=0)


@pytest.mark.parametrize("by_rendering", [False, True])
def test_only_rendering_alone_learns_the_sharpness_of_surfaces(by_rendering):
    shape = FieldShape((0, 0, 0), (1, 1, 1), (0.25,), starts_as_box=by_rendering)
    field = Field(shape, free_m=0.1)
    density = field.density(torch.linspace(-0.02, 0.02, 9, requires_grad=True)).sum()
    density.backward()
    assert bool(field.log_beta.grad is not None and field.log_beta.grad != 0) is by_rendering
    assert field.beta_m.item() == pytest.approx(0.1 if by_rendering else 0.006), "meters"


def test_eikonal_is_zero_on_a_distance_field_and_not_on_a_scaled_one():
    points, step = torch.randn(50, 3), 0.01
    beside = points + step * torch.eye(3)[:, None]
    plane = torch.tensor([0.6, 0.8, 0.0])
    assert losses.eikonal(points @ plane, beside @ plane, step).max() < 1e-3
    assert losses.eikonal(2 * points @ plane, 2 * beside @ plane, step).min() > 0.9


def test_codes_are_swapped_with_the_given_probability():
    video = torch.zeros(20000, dtype=torch.int64)
    generator = torch.Generator().manual_seed(0)
    assert (
        scene.swap_probability(0.0, RayBatches()) == 1.0
        and abs(scene.swap_probability(1.0, RayBatches()) - 0.05) < 1e-9
    )
    assert scene.swap_probability(0.5, RayBatches(swap_first=0.0, swap_last=0.0)) == 0, "no annealing"
    assert (scene.swap_codes(video, 4, 0.0, generator) == 0).all()
    changed = (scene.swap_codes(video, 4, 0.4, generator) != 0).float().mean()
    assert abs(changed - 0.4 * 3 / 4) < 0.02, "a swap may draw the same video again"


def test_fixed_cameras_do_not_move_and_free_ones_move_smoothly():
    pose = torch.eye(4).repeat(30, 1, 1)
    table = MotionTable(pose, pose, torch.eye(4)[None], [10, 20], [False, True], knot_frames=5)
    torch.nn.init.normal_(table.camera, std=0.1)
    moved = table.world_from_camera(torch.arange(30))
    torch.testing.assert_close(moved[:10], pose[:10])
    bend = torch.diff(moved[10:, 0, 3], n=2)
    assert (bend.abs() > 1e-6).sum() <= 3, "corrections bend at knots only"


def test_corrections_are_independent_between_videos():
    pose = torch.eye(4).repeat(30, 1, 1)
    table = MotionTable(pose, pose, torch.eye(4)[None], [10, 20], [True, True], knot_frames=5)
    problem = SimpleNamespace(motion=table, camera_precision=torch.ones(len(table.camera)))
    with torch.no_grad():
        table.camera[table.knot[10] :] = 0.01
    assert not scene.camera_prior(problem)["drift"][1].any()
    with torch.no_grad():
        table.camera[-1] = 0.02
    assert (scene.camera_prior(problem)["drift"][1].sum(1) > 0).tolist() == [False] * 5 + [True]


def test_gaps_are_interpolated_linearly():
    time = np.arange(40) * 0.1
    root = rigid.make(np.tile(np.eye(3), (40, 1, 1)), np.stack([time, 0 * time, 0 * time], axis=-1))
    good = np.ones(40, bool)
    good[5:9] = good[20:36] = False
    garbled = np.where(good[:, None, None], root, 7.0 * np.eye(4))
    result, bones = results.interpolate_gaps(time, garbled, garbled[:, None], good)
    np.testing.assert_allclose(result, root, atol=1e-9)
    np.testing.assert_allclose(bones[:, 0], root, atol=1e-9)
    assert np.isnan(results.interpolate_gaps(time, garbled, garbled[:, None], np.zeros(40, bool))[0]).all()
    gap_s = gaps_s(time, good)
    np.testing.assert_allclose(gap_s[5:9], 0.5)
    np.testing.assert_allclose(gap_s[20:36], 1.7)
    assert (gap_s[good] == 0).all()
    assert (gaps_s(time, time < 1)[10:] == np.inf).all()


def test_surface_of_a_ball_is_closed_and_faces_outwards():
    axis = np.arange(-0.6, 0.61, 0.1)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    ball = zero_level((np.sqrt(x * x + y * y + z * z) - 0.413).astype(np.float32), np.full(3, -0.6), 0.1)
    np.testing.assert_allclose(np.linalg.norm(ball.vertices, axis=-1), 0.413, atol=0.02)
    center = ball.vertices[ball.faces].mean(1)
    assert ((ball.face_normals() * center).sum(-1) > 0).all()
    edges = np.sort(ball.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=-1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
