"""Map look-up at noisy goals and noisy waypoints."""

import numpy as np
import torch

from pipeline.behavior.diffusion import STANDARD
from pipeline.behavior.path_encoding import (
    GOAL_LENGTH_POWER,
    path_from_velocity_channels,
    with_powered_length,
)
from pipeline.behavior.perception import MAP_KEY_CHANNELS
from pipeline.behavior.pointwise import HALF_MAP_M, MAP_CHANNELS, MapAtGoal, WaypointUNet, sample_maps

CELLS = 8
CELL_M = 2 * HALF_MAP_M / CELLS


def coordinate_map() -> torch.Tensor:
    """A map whose first two channels are x and z of the center of each cell, in meters."""
    center = (torch.arange(CELLS) + 0.5) * CELL_M - HALF_MAP_M
    chart = torch.zeros(1, 1, MAP_CHANNELS, CELLS, CELLS)
    chart[:, :, 0], chart[:, :, 1] = center, center[:, None]
    return chart.flatten(2)


def test_lookup_interpolates_the_map():
    points = torch.tensor([[[0.3, 5.0, -1.1], [-1.4, 0.0, 0.9], [2 * HALF_MAP_M, 0.0, 0.0]]])
    read = sample_maps(coordinate_map(), points)[0, 0]
    torch.testing.assert_close(read[:2, :2].T, points[0, :2, ::2], atol=1e-5, rtol=0)
    assert not read[:, 2].any(), "nothing lies beyond the edge"
    assert read.shape == (2 * MAP_KEY_CHANNELS, 3)


def test_map_is_read_at_the_expected_goal():
    reader = MapAtGoal()
    reader.goal_std[:] = torch.tensor([0.8, 0.1, 0.8])
    goal = torch.tensor([[0.5, 0.0, -1.0], [-0.3, 0.0, 0.4]])
    scaled = with_powered_length(goal, GOAL_LENGTH_POWER) / reader.goal_std
    exact, noisy = (
        reader(scaled, torch.full((2, 1), variance), torch.zeros(1, 2, 4), coordinate_map(), 2)[0, :, :2]
        for variance in (0.0, 1e6)
    )
    torch.testing.assert_close(exact, goal[:, ::2], atol=1e-4, rtol=0)
    assert noisy.abs().max() < 1e-2, "of a goal that is all noise one expects that it is here"


def test_waypoints_integrate_strides():
    net = WaypointUNet(1, CELLS, 12, 3, 5, 8, (1, 2, 4))
    net.velocity_std[:] = torch.tensor([0.7, 0.1, 0.7, 1.0])
    strides = np.random.default_rng(0).standard_normal((2, 12, 4)).astype(np.float32)
    scaled = torch.from_numpy(strides / net.velocity_std.numpy()).mT * STANDARD.alpha_bar[0] ** -0.5
    np.testing.assert_allclose(
        net.waypoints(scaled, torch.zeros(2)),
        path_from_velocity_channels(strides, np.zeros((2, 3))),
        atol=1e-5,
    )


def test_map_is_read_along_the_path():
    torch.manual_seed(0)
    net = WaypointUNet(1, CELLS, 12, 3, 5, 8, (1, 2, 4))
    rest = torch.zeros(1, 5), torch.zeros(1, 3), torch.ones(1, 1)
    x, t = torch.randn(1, 4, 12), torch.zeros(1)
    here, elsewhere = (
        net(x, t, torch.cat([chart.flatten(1), rest[0]], dim=1), *rest[1:])
        for chart in (coordinate_map(), -coordinate_map())
    )
    assert (here - elsewhere).abs().max() > 1e-3
