"""Foundation models run on a simulated second device; DINOv2 does in the tests of the stages that use it."""

import numpy as np
import pytest
import torch

from pipeline.backends import raft
from pipeline.backends.grounding_dino import GroundingDino
from pipeline.backends.monocular_depth import MonocularDepth
from pipeline.backends.sam2 import Sam2
from tests.pipeline.backends import small_checkpoints
from tests.simulated_device import DEVICE, simulated_device

COLOR = np.random.default_rng(0).integers(0, 255, (90, 66, 3), dtype=np.uint8)


def test_detector_and_tracker_run_on_another_device(tmp_path):
    detector, tracker = small_checkpoints.grounding_dino(tmp_path), small_checkpoints.sam2(tmp_path / "sam2")
    with simulated_device():
        boxes, _ = GroundingDino(str(detector), DEVICE).find(COLOR, "a cat.", 0.0)
        masks = list(Sam2(str(tracker), DEVICE).track(lambda frame: COLOR, range(3), boxes[0]))
    assert len(masks) == 3 and np.isfinite(boxes).all()


@pytest.mark.parametrize("kind", ["depth_anything_v2", "depth_pro"])
def test_depth_is_estimated_on_another_device(kind, tmp_path):
    write = (
        small_checkpoints.depth_pro
        if kind == "depth_pro"
        else lambda path: small_checkpoints.depth_anything(path, "metric")
    )
    weights = str(write(tmp_path))
    with simulated_device():
        assert np.isfinite(MonocularDepth(kind, weights, DEVICE).inverse_depth(COLOR)).all()


def test_flow_is_estimated_on_another_device(tmp_path):
    torch.manual_seed(0)
    torch.save(
        {f"module.{name}": value for name, value in raft.Raft().state_dict().items()}, tmp_path / "raft.pth"
    )
    with simulated_device():
        flow = raft.flow_between(raft.load(tmp_path / "raft.pth", DEVICE), COLOR, COLOR, 1)
    assert np.isfinite(flow).all()
