"""Grounding DINO and SAM 2 as a backend: ordered masks for all frames, from any prompted frame."""

import numpy as np
import pytest

from pipeline.core.errors import InputError
from stages.segment_agent.backends import foundation
from stages.segment_agent.config import FoundationConfig
from stages.segment_agent.prompts import Prompt
from tests.pipeline.backends import small_checkpoints


class Clip:
    """Nine pictures with a moving patch."""

    folder = "memory"
    color_size = (48, 64)

    def __len__(self) -> int:
        return 9

    def color(self, frame: int) -> np.ndarray:
        picture = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
        picture[15:35, 12 + frame : 32 + frame] = [200, 120, 40]
        return picture


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    tracker = small_checkpoints.sam2(tmp_path_factory.mktemp("sam2"))
    detector = small_checkpoints.grounding_dino(tmp_path_factory.mktemp("grounding_dino"))
    return FoundationConfig(str(detector), str(tracker), threshold=0.0)


@pytest.mark.slow
def test_prompt_is_propagated_in_both_directions(options):
    from pipeline.backends.sam2 import Sam2

    prompt, clip = Prompt(4, (14.0, 14, 40, 36)), Clip()
    masks = list(foundation.segment(clip, prompt, options, "cpu"))
    assert len(masks) == 9
    tracker = Sam2(options.tracker, "cpu")
    for order in (range(4, -1, -1), range(4, 9)):
        for frame, (log_odds, presence) in zip(
            order, tracker.track(clip.color, order, np.array(prompt.box_px)), strict=True
        ):
            np.testing.assert_array_equal(
                masks[frame].labels, foundation.labeled(log_odds, presence, foundation.UNSURE).labels
            )


def test_detector_replaces_the_prompt_or_reports_no_detection(options):
    assert len(list(foundation.segment(Clip(), None, options, "cpu"))) == 9
    strict = FoundationConfig(options.detector, options.tracker, threshold=1.0)
    with pytest.raises(InputError, match="MSK-004.*a cat"):
        foundation.segment(Clip(), None, strict, "cpu")


def test_log_odds_are_converted_to_labels():
    mask = foundation.labeled(np.array([[5.0, 0.5, -5]]), 2.0, 1.0)
    assert mask.labels.tolist() == [[255, 128, 0]]
    assert mask.visible
    gone = foundation.labeled(np.array([[5.0, 0.5, -5]]), -2.0, 1.0)
    assert not gone.visible
    assert not gone.labels.any()
    assert gone.confidence > 0.8


def test_click_is_converted_to_a_box():
    box = foundation.widened(Prompt(0, (1.0, 20, 1, 20)), (48, 64))
    np.testing.assert_allclose(box, [0, 18.72, 2.28, 21.28])
    np.testing.assert_allclose(foundation.widened(Prompt(0, (10.0, 10, 30, 40)), (48, 64)), [10, 10, 30, 40])


def test_missing_weights_are_refused():
    with pytest.raises(InputError, match="MOD-001"):
        foundation.segment(Clip(), Prompt(0, (1.0, 1, 9, 9)), FoundationConfig(), "cpu")
