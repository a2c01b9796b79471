"""Optical flow of shifted and rotated textures on the stored grid, with confidences."""

import cv2
import numpy as np
import pytest
import torch

from pipeline.backends import raft
from pipeline.data import npz
from stages.estimate_flow import stage
from stages.estimate_flow.backends.raft import UPDATES, RaftEstimator
from stages.estimate_flow.config import Config
from stages.estimate_flow.estimation import Estimator, flows, grid_centers
from tests.stages.written_frames import write_frames

WORKING_SIDE_PX = 320


def texture(height, width, seed=0):
    """A smooth random RGB picture."""
    rng = np.random.default_rng(seed)
    noise = sum(
        cv2.resize(rng.normal(size=(height // s, width // s)), (width, height), interpolation=cv2.INTER_CUBIC)
        * s
        for s in (4, 8, 16)
    )
    scaled = (noise - noise.min()) / np.ptp(noise) * 255
    return np.repeat(scaled.astype(np.uint8)[..., None], 3, axis=-1)


def moved(image, matrix):
    """Warp so that the point p (pixel centers at +0.5) moves to matrix @ (p, 1)."""
    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    indexed = np.linalg.inv(shift) @ np.vstack([matrix, [0, 0, 1]]) @ shift
    return cv2.warpAffine(
        image, indexed[:2], image.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )


def both_ways(estimator, pair):
    """Forward and backward flow between two reduced pictures."""
    _, forward, backward = next(flows(pair.__getitem__, 2, (1,), estimator))
    return forward, backward


@pytest.mark.parametrize("size", [(160, 120), (120, 160), (400, 300), (162, 121)])
@pytest.mark.parametrize("matrix", [[[1, 0, 5.0], [0, 1, -3.0]], [[0.999, -0.04, 4.0], [0.04, 0.999, -2.0]]])
def test_known_motion_is_estimated_in_color_pixels(size, matrix):
    matrix = np.array(matrix)
    estimator = Estimator(size, WORKING_SIDE_PX)
    pair = [estimator.reduce(picture) for picture in (texture(*size), moved(texture(*size), matrix))]
    forward, backward = both_ways(estimator, pair)
    grid_px = grid_centers(size)
    true_px = grid_px @ matrix[:, :2].T + matrix[:, 2] - grid_px
    error_px = np.linalg.norm(forward.flow - true_px, axis=-1)[4:-4, 4:-4]
    assert np.median(error_px) < 0.3  # the search is accurate to a quarter of a pixel on smooth texture
    assert np.median(forward.confidence[4:-4, 4:-4]) > 180
    np.testing.assert_allclose(np.median(backward.flow + forward.flow, axis=(0, 1)), 0, atol=0.3)


def test_occluded_and_changed_regions_have_low_confidence():
    size = (160, 120)
    estimator = Estimator(size, WORKING_SIDE_PX)
    first, second = texture(*size), moved(texture(*size), np.array([[1, 0, 30.0], [0, 1, 0]]))
    second[60:100, 40:80] = texture(40, 40, seed=5)
    confidence = both_ways(estimator, [estimator.reduce(picture) for picture in (first, second)])[
        0
    ].confidence
    assert np.median(confidence[:, -6:]) < 20
    assert np.median(confidence[16:24, 4:11]) < 100


def test_pairs_are_ordered_and_few_frames_are_read_twice():
    estimator = Estimator((64, 48), WORKING_SIDE_PX)
    gray, asked = estimator.reduce(texture(64, 48)), []

    def ask(frame):
        asked.append(frame)
        assert frame >= max(asked) - 4
        return gray

    gaps = [gap for gap, _, _ in flows(ask, 12, (1, 2, 4), estimator)]
    assert {gap: gaps.count(gap) for gap in (1, 2, 4)} == {1: 11, 2: 10, 4: 8}
    assert [gap for gap, _, _ in flows(lambda _: gray, 3, (1, 2, 4, 8), estimator)] == [1, 1, 2]


def test_stage_writes_all_gaps_in_both_directions(tmp_path):
    frames, out = tmp_path / "frames", tmp_path / "flow"
    shifted = [moved(texture(64, 48), np.array([[1, 0, i], [0, 1, 0.0]])) for i in range(10)]
    write_frames(frames, shifted, np.ones((8, 6)))
    out.mkdir()
    stage.run(stage.Inputs(frames=frames), Config(), out)
    for gap in (1, 2, 4, 8):
        for sign, way in ((1, "fw"), (-1, "bw")):
            table = npz.load(tmp_path / "flow" / f"flow_{gap}_{way}.npz")
            assert table["flow"].shape == (10 - gap, 16, 12, 2)
            assert table["flow"].dtype == np.float16
            assert table["confidence"].dtype == np.uint8
            median_px = np.median(table["flow"][:, 4:-4, 3:-3].astype(float), axis=(0, 1, 2))
            np.testing.assert_allclose(median_px, [sign * gap, 0], atol=0.5)


def test_long_gaps_are_initialized_by_chained_flow():
    world = texture(200, 460)
    estimator = Estimator((160, 120), WORKING_SIDE_PX)
    gray = [estimator.reduce(world[20:180, 12 * i : 12 * i + 120]) for i in range(9)]
    forward = [forward for gap, forward, _ in flows(gray.__getitem__, 9, (1, 2, 4), estimator) if gap == 4]
    error_px = np.linalg.norm(forward[2].flow[8:-8, 16:-4] - np.array([-48.0, 0.0]), axis=-1)
    assert np.median(error_px) < 1.5


def test_small_object_with_opposite_motion_is_detected():
    room, thing = texture(240, 200, 1), texture(40, 30, 2)
    pictures = [room[:200, 8 * i : 8 * i + 160].copy() for i in range(2)]
    for i, picture in enumerate(pictures):
        picture[80:120, 60 + 4 * i : 90 + 4 * i] = thing
    estimator = Estimator((200, 160), WORKING_SIDE_PX)
    forward, _ = both_ways(estimator, [estimator.reduce(picture) for picture in pictures])
    np.testing.assert_allclose(
        np.median(forward.flow[22:28, 17:21].astype(float), axis=(0, 1)), [4, 0], atol=1.0
    )


def test_network_writes_the_same_gaps_and_grid():
    torch.manual_seed(0)
    network = raft.Raft().eval()
    estimator = RaftEstimator(network, (64, 80), 80)
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 255, (3, 64, 80, 3), dtype=np.uint8)
    made = list(flows(lambda i: estimator.reduce(pictures[i]), 3, (1, 2), estimator))
    assert [gap for gap, _, _ in made] == [1, 1, 2]
    assert made[0][1].flow.shape == (16, 20, 2)
    assert made[2][2].confidence.shape == (16, 20)
    expected = raft.flow_between(network, pictures[0], pictures[1], UPDATES)
    on_grid = cv2.resize(expected, (20, 16), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(made[0][1].flow.astype(np.float32), on_grid, atol=0.01 * np.abs(on_grid).max())
