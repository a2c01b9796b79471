"""The form of the papers: geometry learned by differentiable rendering, with per-video codes and annealing."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.fields.fields import Reconstruction, density
from pipeline.fields.render import importance_depths, ray_weights, render_depth
from stages.reconstruct import assemble, optimize
from stages.reconstruct.config import LearningRates, LossWeights, RayBatches
from stages.reconstruct.problem import Problem
from stages.reconstruct.scene import SceneLoss
from tests.stages.reconstruct.test_optimize import RADIUS_M, SHAPES, UPRIGHT, WIDE, film, template

STEPS = 80
WEIGHTS = replace(LossWeights(), rendered_depth=1.0)


def learned(batches: RayBatches, weights: LossWeights = WEIGHTS) -> tuple[Problem, list]:
    """Return the problem after the first steps of the scene phase, from two sessions and a turnaround."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    videos = [film(name, 10, True, rng) for name in ("v002", "v003")] + [film("v001", 4, False, rng, UPRIGHT)]
    sizes = replace(SHAPES, encoding="mlp", scene_voxel_m=(0.4, 0.1))
    problem = assemble.build(videos, template(RADIUS_M), sizes, 0, "cpu", rendered=True)
    loss = SceneLoss(problem, weights, batches, STEPS, rendered=True)
    optimizer = torch.optim.AdamW(optimize.field_groups(problem.scene, LearningRates()), lr=1.0)
    for step in range(STEPS):
        optimizer.zero_grad()
        sum(loss(step, torch.Generator().manual_seed(step)).values()).backward()
        torch.nn.utils.clip_grad_norm_(problem.scene.parameters(), optimize.CLIP_NORM)
        optimizer.step()
    return problem, videos


@pytest.fixture(scope="module")
def with_annealing() -> tuple[Problem, list]:
    return learned(RayBatches(scene_rays=96, rendered_samples=40))


def geometry(problem: Problem, code: int) -> torch.Tensor:
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) * 2.6 - 1.3
    with torch.no_grad():
        return problem.scene.distance_at(points, torch.full((300,), code))


def test_rendered_depth_is_correct_without_surface_losses(with_annealing):
    problem, videos = with_annealing
    reconstruction = Reconstruction(problem.scene, problem.agent, problem.body, assemble.scene_ids(videos))
    views = videos[0].store.views
    intrinsics = views.intrinsics[0].numpy() / np.array([[4.0], [4.0], [1.0]])
    depth, agent = render_depth(
        reconstruction, videos[0].world_from_camera[0], intrinsics, *WIDE, 4.0, "v002", samples=64
    )
    measured = views.depth[0].float().numpy()
    beside = (measured > 0) & (views.outside_px[0].float().numpy() > 4)
    assert (np.abs(depth - measured) < 0.1)[beside].mean() > 0.9, "meters; the paper's DepthAcc"
    assert not agent.any(), "its pose was not given"


def test_codes_change_geometry(with_annealing):
    problem = with_annealing[0]
    assert (geometry(problem, 0) - geometry(problem, 1)).abs().max() > 1e-5
    other = learned(RayBatches(scene_rays=96, rendered_samples=40, swap_first=0.0, swap_last=0.0))[0]
    assert (geometry(problem, 0) - geometry(other, 0)).abs().max() > 1e-3


def test_feature_loss_has_gradients_for_geometry(with_annealing):
    other = learned(RayBatches(scene_rays=96, rendered_samples=40), replace(WEIGHTS, rendered_feature=0.0))[0]
    assert (geometry(with_annealing[0], -1) - geometry(other, -1)).abs().max() > 1e-3


def test_importance_samples_lie_at_the_surface():
    depth = torch.linspace(0.1, 4, 40).expand(2, -1)
    wall = density(torch.tensor([[1.5], [3.0]]) - depth, torch.tensor(0.05))
    fine = importance_depths(depth, torch.ones(2), wall, torch.Generator().manual_seed(0))
    assert (fine.diff(dim=1) >= 0).all() and fine.shape == depth.shape
    assert ((fine - torch.tensor([[1.5], [3.0]])).abs() < 0.25).float().mean() > 0.9
    empty = importance_depths(depth, torch.ones(2), torch.zeros_like(depth))
    torch.testing.assert_close(empty, depth, atol=0.11, rtol=0)


def test_every_ray_hits_a_thin_fused_wall():
    """Fused distances end 6 cm behind a surface; the first pass samples every 9 cm."""
    wall_m = torch.linspace(1, 4, 500)[:, None]
    depth = torch.linspace(0.1, 5.9, 65).expand(500, -1)

    def wall(at: torch.Tensor, beta_m: float) -> torch.Tensor:
        before = (wall_m - at).clamp_max(0.06)
        behind = 2 * (at - wall_m - 0.06) - 0.06
        return density(torch.maximum(before, behind.clamp_max(0.06)), torch.tensor(beta_m), 0.06)

    spacing_m = float(depth[0, 1] - depth[0, 0])
    fine = importance_depths(depth, torch.ones(500), wall(depth, spacing_m / 2))
    both = torch.cat([depth, fine], dim=1).sort(dim=1).values
    weight = ray_weights(both, torch.ones(500), wall(both, 0.005))
    assert (weight.sum(1) > 0.99).all()
    assert ((weight * both).sum(1) / weight.sum(1) - wall_m[:, 0]).abs().max() < 0.02, "meters"
