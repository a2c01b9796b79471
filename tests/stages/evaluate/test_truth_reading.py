"""Ground truth of the extracted frames; masks and flow are compared where both are known."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.data import images, npz
from pipeline.data.clips import Masks
from stages.evaluate import perception
from stages.evaluate.truth import RecordingTruth, read_flow

FRAMES = 9


@pytest.fixture
def folder(tmp_path):
    """A recording of 9 frames with an animal that moves one pixel per frame."""
    masks = np.zeros((FRAMES, 16, 12), bool)
    for i in range(FRAMES):
        masks[i, 4:10, i % 4 : i % 4 + 5] = True
    npz.save(tmp_path / "s.masks.npz", packed=np.packbits(masks, axis=-1), shape=np.array(masks.shape))
    eye = np.tile(np.eye(4), (FRAMES, 1, 1))
    camera = eye.copy()
    camera[:, 0, 3] = np.arange(FRAMES)
    npz.save(
        tmp_path / "s.npz", timestamp_s=np.arange(FRAMES) / 15, world_from_camera=camera,
        intrinsics=eye[:, :3, :3],
        agent_visible=np.ones(FRAMES, bool), moving=np.arange(FRAMES) % 2 == 0, world_from_agent=camera,
        agent_vertices_world=np.zeros((FRAMES, 5, 3), np.float16),
    )  # fmt: skip
    flow = np.full((3, 4, 3, 2), 2.0, np.float16)
    flow[0, 0, 0] = np.nan
    npz.save(
        tmp_path / "s.flow.npz", frame_index=np.array([0, 3, 5]), second_index=np.array([1, 5, 6]), flow=flow
    )
    return tmp_path


SOURCE = np.array([0, 1, 3, 6, 8])


def test_truth_follows_the_extracted_frames(folder):
    truth = RecordingTruth.open(folder, "s", SOURCE)
    assert np.array_equal(truth.world_from_camera[:, 0, 3], SOURCE)
    assert truth.masks.shape == (5, 16, 12)
    assert truth.masks[2, 5, 3]
    assert not truth.masks[2, 5, 2]
    np.testing.assert_allclose(truth.vertices_world(3)[:, 0], 6)


def test_only_flow_between_adjacent_frames_counts(folder):
    true = read_flow(folder, "s", SOURCE)
    assert true.first.tolist() == [0]
    ours = np.zeros((4, 4, 3, 2))
    metrics = perception.flow_metrics([(ours, true, RecordingTruth.open(folder, "s", SOURCE).masks)])
    assert metrics.values["flow/epe_px_mean"] == pytest.approx(np.sqrt(8))
    assert metrics.values["flow/zero_flow_epe_px_mean"] == pytest.approx(np.sqrt(8))
    assert read_flow(folder, "other", SOURCE) is None


def test_masks_are_compared_where_known(folder):
    truth, out = RecordingTruth.open(folder, "s", SOURCE), folder / "masks"
    out.mkdir()
    for i, true in enumerate(truth.masks):
        label = np.where(true, 255, 0).astype(np.uint8)
        label[[0, 4]] = 128
        if i == 4:
            label[:] = 0
        images.write_gray(out / f"{i:06d}.png", label)
    npz.save(
        out / "masks.npz",
        visible=np.ones(5, bool),
        confidence=np.ones(5, np.float32),
        area=np.ones(5, np.float32),
    )
    found = perception.overlaps(Masks.open(out), truth)
    np.testing.assert_allclose(found.iou, [1, 1, 1, 1, 0])
    metrics = perception.mask_metrics([found], None)
    assert metrics.values["masks/iou_mean"] == pytest.approx(0.8)
    assert metrics.values["masks/iou_resting"] == 1.0
    assert metrics.values["masks/unknown_share"] == pytest.approx(4 / 5 / 6), "a row of six of four masks"
    assert metrics.values["masks/iou_turnaround"] is None
    assert "masks/identity_swaps" not in metrics.values, "nobody else is there"
    others = np.roll(truth.masks, 6, axis=1) & ~truth.masks
    npz.save(
        folder / "s.others.npz",
        packed=np.packbits(np.zeros((FRAMES, 16, 12), bool), axis=-1),
        shape=np.array([FRAMES, 16, 12]),
    )
    truth = RecordingTruth.open(folder, "s", SOURCE)
    assert perception.overlaps(Masks.open(out), truth).swapped.tolist() == [False] * 5
    swapped = perception.overlaps(Masks.open(out), replace(truth, masks=others, others=truth.masks)).swapped
    assert swapped.tolist() == [True] * 4 + [False], "the last mask is empty"
