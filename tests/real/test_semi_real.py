"""The built-in animal rendered into fifty frames of a real kitchen: ground truth, occlusion, and extraction."""

import numpy as np
import pytest

from benchmarks import semi_real
from benchmarks.composited import Sequence
from pipeline.data import npz
from pipeline.recordings.formats import open_recording
from tests.real.seven_scenes import SCENE


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    if not SCENE.exists():
        pytest.skip(f"no real kitchen at {SCENE} (set ATS_REALDATA)")
    out = tmp_path_factory.mktemp("semi_real")
    sequence = Sequence.open(SCENE, first=500)
    semi_real.draw(sequence, out, "session-1", seed=1)
    return sequence, out


def test_recording_is_extracted_with_its_ground_truth(drawn):
    sequence, out = drawn
    recording = open_recording(out / "recordings" / "session-1")
    truth = semi_real.read_truth(out / "truth" / "session-1.npz", recording.index)
    assert len(truth) == len(sequence.numbers)
    there = truth.any((1, 2))
    assert 0.15 < there.mean() < 0.9, "the animal comes and goes"


def test_animal_changes_color_and_depth_only_in_its_mask(drawn):
    sequence, out = drawn
    recording = open_recording(out / "recordings" / "session-1")
    truth = semi_real.read_truth(out / "truth" / "session-1.npz", recording.index)
    for row in np.flatnonzero(truth.mean((1, 2)) > 0.01)[:4]:
        before, after = sequence.depth(row), recording.read_depth(int(recording.index[row]))
        known = (before > 0) & (after > 0)
        assert (after <= before + 0.03)[truth[row] & known].mean() > 0.95, "it hides what lies behind"
        assert (np.abs(after - before) < 0.002)[~truth[row] & known].mean() > 0.97
    for row in np.flatnonzero(~truth.any((1, 2)))[:3]:
        np.testing.assert_allclose(
            recording.read_depth(int(recording.index[row])), sequence.depth(row), atol=6e-4
        )


def test_mask_metrics_have_known_values():
    truth = np.zeros((4, 10, 10), bool)
    truth[:2, 2:6, 2:6] = True
    labels = np.where(truth, 255, 0)
    labels[0, 5, 2:6] = 0
    labels[1, 0, 0] = 128
    labels[2, 0, :8] = 255
    found = semi_real.mask_metrics(labels, truth)
    assert found["false_frames"] == 0.5
    assert found["found_frames"] == 1.0
    assert found["precision"] == pytest.approx(28 / 36)
    assert found["iou_mean"] == pytest.approx((12 / 16 + 1) / 2)


def test_truth_is_found_by_frame_number(tmp_path):
    masks = np.zeros((3, 2, 8), bool)
    masks[1] = True
    npz.save(
        tmp_path / "t.npz",
        packed=np.packbits(masks, axis=-1),
        shape=np.array(masks.shape),
        source_index=np.array([0, 3, 6]),
    )
    assert semi_real.read_truth(tmp_path / "t.npz", np.array([3, 6])).any((1, 2)).tolist() == [True, False]
