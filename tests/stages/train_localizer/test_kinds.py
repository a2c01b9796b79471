"""The pose regressor learns, survives saving, and its confidence ranks errors."""

import numpy as np
import pytest
import torch

from pipeline.geometry import rigid
from pipeline.localization import localizer as model
from pipeline.localization.networks import GRID, on_grid, pose_loss
from pipeline.localization.patches import Patches, PatchSampling, PcaBasis
from pipeline.metrics.pose_errors import pose_errors
from stages.train_localizer.config import NetworkConfig
from stages.train_localizer.described_views import DescribedViews
from stages.train_localizer.networks import train_regressor

AXES = 16


def described(views: int, seed: int) -> DescribedViews:
    """Return views of points in a box, described by smooth functions of position; a tenth of the descriptors
    is noise.
    """
    rng, fixed = np.random.default_rng(seed), np.random.default_rng(0)
    poses = rigid.exp(
        np.concatenate([rng.normal(0, 0.35, (views, 3)), rng.uniform(-0.7, 0.7, (views, 3))], axis=1)
    )
    cell = np.stack(np.meshgrid(np.arange(12), np.arange(9), indexing="ij"), axis=-1).reshape(-1, 2)
    frequency, phase = fixed.normal(0, 1.2, (3, AXES)), fixed.uniform(0, 6, AXES)
    patches, descriptors = [], []
    for pose in poses:
        camera = np.concatenate(
            [(cell[:, ::-1] - (4, 5.5)) * 0.12, np.ones((len(cell), 1))], axis=1
        ) * rng.uniform(1.5, 2.0)
        descriptor = np.sin(rigid.apply(pose, camera) @ frequency + phase)
        spoilt = rng.random(len(cell)) < 0.1
        descriptor[spoilt] = rng.normal(0, 1, (spoilt.sum(), AXES))
        descriptors.append(descriptor / np.linalg.norm(descriptor, axis=1, keepdims=True))
        patches.append(Patches(descriptors[-1], camera, cell))
    basis = PcaBasis(np.zeros(AXES, np.float32), np.eye(AXES, dtype=np.float32))
    return DescribedViews(
        basis, np.concatenate(descriptors).astype(np.float32), patches, np.arange(views), poses
    )


def asked(net, seen: DescribedViews) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rotation errors (degrees), translation errors (meters) and scores of all views."""
    sampling, solver = PatchSampling("scene", 100.0, 0, 8, (6,)), model.RansacSolver(0.15, 0.3, 200, 1)
    localizer = model.Localizer(sampling, seen.basis, net, model.Calibration(0.0, 1.0), solver)
    answers = [localizer.localize_patches(patches)[0] for patches in seen.patches]
    errors = pose_errors(np.stack([answer.map_from_camera for answer in answers]), seen.map_from_camera)
    return errors.degrees, errors.meters, np.array([answer.inlier_ratio for answer in answers])


@pytest.mark.slow
def test_poses_are_regressed():
    net = train_regressor(
        described(150, 1), "scene", NetworkConfig(steps=300, batch_views=32, pose_width=16), 0
    )
    rotation, distance, certainty = asked(net, described(40, 2))
    assert np.median(rotation) < 20, "degrees; guessing has 34"
    assert np.median(distance) < 0.4, "meters; guessing has 0.7"
    assert ((certainty > 0) & (certainty < 1)).all()


def test_optimal_uncertainty_is_the_error():
    log_scale = torch.linspace(-4, 1, 400)
    turned = torch.from_numpy(rigid.exp(np.array([0, 0.2, 0, 0, 0, 0]))[:3, :3].astype(np.float32)).expand(
        400, 3, 3
    )
    error, surprise = pose_loss(
        torch.eye(3).expand(400, 3, 3),
        torch.zeros(400, 3),
        log_scale,
        turned,
        torch.tensor([0.0, 0.0, 0.1]).expand(400, 3),
    )
    assert torch.allclose(error, torch.tensor(0.21), atol=1e-4), "0.2 rad + (0.1 m)^2"
    assert abs(float(log_scale[surprise.argmin()]) - np.log(0.3)) < 0.02


def test_networks_survive_saving(tmp_path):
    seen = described(20, 1)
    net = train_regressor(seen, "agent", NetworkConfig(steps=3, batch_views=4, pose_width=8), 0)
    sampling, solver = PatchSampling("agent", 100.0, 96, 8, (6, 12)), model.RansacSolver(0.1, 0.2, 50, 1)
    localizer = model.Localizer(sampling, seen.basis, net, model.Calibration(0.1, 2.0), solver)
    model.save(tmp_path, localizer, {})
    again = model.load(tmp_path)
    assert again.sampling == localizer.sampling
    pairs = zip(again.model.state_dict().values(), net.state_dict().values(), strict=True)
    assert all(torch.equal(first, second) for first, second in pairs)
    first, second = (each.localize_patches(seen.patches[0]) for each in (localizer, again))
    assert [a.inlier_ratio for a in first] == [a.inlier_ratio for a in second]


def test_patches_are_ordered_grid_cells():
    cell = np.stack(np.meshgrid(np.arange(13), np.arange(10), indexing="ij"), axis=-1).reshape(-1, 2)
    grid = on_grid(np.arange(1, len(cell) + 1, dtype=np.float32)[:, None], cell)
    assert grid.shape == (1, GRID, GRID)
    assert grid[grid > 0].tolist() == list(range(1, len(cell) + 1))
    assert (on_grid(np.ones((len(cell), 1), np.float32), cell * 3) > 0).any(), "larger pictures are thinned"
