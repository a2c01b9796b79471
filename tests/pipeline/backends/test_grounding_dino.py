"""The Grounding DINO backend agrees with transformers on a small checkpoint with random weights."""

import numpy as np
import pytest

from tests.pipeline.backends import small_checkpoints


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return small_checkpoints.grounding_dino(tmp_path_factory.mktemp("grounding_dino"))


@pytest.mark.parametrize("size", [(90, 66), (60, 120)])
def test_detections_equal_those_of_transformers(checkpoint, size):
    import torch
    import transformers
    from transformers.models.grounding_dino.image_processing_pil_grounding_dino import (
        GroundingDinoImageProcessorPil,
    )

    from pipeline.backends.grounding_dino import GroundingDino

    color = np.random.default_rng(0).integers(0, 255, (*size, 3), dtype=np.uint8)
    our_boxes, our_score = GroundingDino(str(checkpoint), "cpu").find(color, "a cat.", 0.0)
    processor = GroundingDinoImageProcessorPil.from_pretrained(checkpoint)
    inputs = processor(color, return_tensors="pt", input_data_format="channels_last")
    words = transformers.AutoTokenizer.from_pretrained(checkpoint)("a cat.", return_tensors="pt")
    model = transformers.GroundingDinoForObjectDetection.from_pretrained(checkpoint).eval()
    with torch.no_grad():
        answer = model(**inputs, **words)
    score = answer.logits[0].sigmoid().max(-1).values
    order = torch.argsort(score, descending=True)
    center, extent = answer.pred_boxes[0][order].split(2, dim=-1)
    boxes = torch.cat([center - extent / 2, center + extent / 2], -1) * torch.tensor([size[1], size[0]] * 2)
    np.testing.assert_allclose(our_score, score[order].numpy(), atol=1e-4)
    np.testing.assert_allclose(our_boxes, boxes.numpy(), atol=1e-2)
    assert len(GroundingDino(str(checkpoint), "cpu").find(color, "a cat", 1.0)[1]) == 0
