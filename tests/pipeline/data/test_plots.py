"""Plotting helpers draw at the right positions."""

import numpy as np
import pytest

from pipeline.data import plots


def test_grid_keeps_all_pictures_and_pads_smaller_ones():
    images = [
        np.full((4, 6, 3), 10, np.uint8),
        np.full((2, 3, 3), 20, np.uint8),
        np.full((4, 6, 3), 30, np.uint8),
    ]
    sheet = plots.grid(images, 2)
    assert sheet.shape == (8, 12, 3)
    assert (sheet[:4, :6] == 10).all() and (sheet[:2, 6:9] == 20).all() and (sheet[4:, :6] == 30).all()
    assert (sheet[2:4, 6:] == plots.BACKGROUND).all() and (sheet[4:, 6:] == plots.BACKGROUND).all()


def test_outline_surrounds_the_mask_without_modifying_the_picture():
    image, mask = np.zeros((9, 9, 3), np.uint8), np.zeros((9, 9), bool)
    mask[3:6, 3:6] = True
    drawn = plots.outlined(image, mask, (1, 2, 3))
    colored = (drawn == (1, 2, 3)).all(-1)
    assert colored[2:7, 2:7].sum() == 16 == colored.sum() and not colored[mask].any()
    assert not image.any()


def test_depth_colors_of_near_far_and_unknown():
    near, far, unknown = plots.depth_colors(np.array([[0.1, 3.9, 0.0]]))[0].astype(int)
    assert near[0] > 200 and near[2] < 100
    assert far[2] > far[1]
    assert not unknown.any()


def test_running_mean_keeps_the_mean_and_reduces_noise():
    noise = np.random.default_rng(0).normal(5, 1, 1000)
    means = plots.running_mean(noise)
    assert len(means) == 1000 - 20 + 1
    assert abs(means.mean() - 5) < 0.1 and means.std() < 0.5
    assert plots.running_mean(noise[:7]).tolist() == noise[:7].tolist()


def test_floor_plan_draws_solid_columns_at_their_position():
    figure, axes = plots.panels(1, 1, width_in=4, height_in=4)
    solid = np.zeros((10, 20))
    solid[9, 0] = 1  # the largest x, the smallest z
    plots.floor_plan(axes[0, 0], solid, np.array([-1.0, -2.0]), 0.2)
    assert axes[0, 0].get_images()[0].get_extent() == pytest.approx([-1.0, 1.0, 2.0, -2.0])
    axes[0, 0].set_axis_off()
    figure.set_layout_engine("none")
    axes[0, 0].set_position([0, 0, 1, 1])
    dark = plots.pixels(figure).mean(-1) < 200
    row, column = (where.mean() / side for where, side in zip(np.nonzero(dark), dark.shape, strict=True))
    assert column > 0.6 and row < 0.1, "right and up"


def test_charts_have_the_requested_size_and_curves():
    losses = {
        "goal": {"ours": np.geomspace(1, 0.1, 200), "baseline": np.ones((2, 200))},
        "path": {"ours": np.ones(3)},
    }
    assert plots.loss_curves(losses).shape == (240, 720, 3)
    seen = plots.histograms({"error": np.array([0.1, 1, 10, np.nan, -1])}, log=True, good_below=2.0)
    green, orange = (
        (np.abs(seen.astype(int) - color).max(-1) < 20).any() for color in ((85, 168, 104), (221, 132, 82))
    )
    assert green and orange
    absent = np.arange(50) < 25
    shown = plots.time_series("area", np.ones(50) * ~absent, np.arange(50) / 10, absent).astype(int)
    red = (shown[..., 0] > shown[..., 2] + 20).mean(0)
    assert red[: len(red) // 2].max() > 0.5 > 0.1 > red[-len(red) // 3 :].max()
