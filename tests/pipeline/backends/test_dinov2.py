"""The DINOv2 backend agrees with transformers on a small checkpoint with random weights."""

import numpy as np
import pytest

from pipeline.backends import checkpoints
from pipeline.backends.descriptors import Describer
from pipeline.backends.dinov2 import Dinov2
from pipeline.core.errors import InputError
from tests.pipeline.backends import small_checkpoints


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return small_checkpoints.dinov2(tmp_path_factory.mktemp("dinov2"))


def test_features_equal_those_of_transformers(checkpoint):
    import torch
    import transformers
    from transformers.models.bit.image_processing_pil_bit import BitImageProcessorPil

    color = np.random.default_rng(0).integers(0, 255, (90, 66, 3), dtype=np.uint8)
    ours = Dinov2(str(checkpoint), "cpu").describe(color, 8)
    assert ours.shape == (11, 8, 24)
    processor = BitImageProcessorPil.from_pretrained(
        checkpoint, do_center_crop=False, size={"height": 11 * 14, "width": 8 * 14}
    )
    pixels = processor(color[:88, :64], return_tensors="pt", input_data_format="channels_last")[
        "pixel_values"
    ]
    model = transformers.Dinov2Model.from_pretrained(checkpoint).eval()
    with torch.no_grad():
        tokens = model(pixel_values=pixels).last_hidden_state[0, 1:].reshape(11, 8, 24)
    np.testing.assert_allclose(ours, torch.nn.functional.normalize(tokens, dim=-1).numpy(), atol=1e-4)


def test_descriptor_choice_is_saved(checkpoint, tmp_path):
    Describer("dinov2", str(checkpoint)).save(tmp_path)
    describe = Describer.load(tmp_path).open("cpu")
    assert describe(np.zeros((32, 48, 3), np.uint8), 16).shape == (2, 3, 24)


def test_other_model_type_is_refused(checkpoint, tmp_path):
    (tmp_path / "config.json").write_text('{"model_type": "bert"}')
    with pytest.raises(InputError, match="MOD-003"):
        Dinov2(str(tmp_path), "cpu")


def test_missing_weights_are_named(tmp_path):
    for weights in ("", str(tmp_path)):
        with pytest.raises(InputError, match="MOD-001.*config.json") as refused:
            Dinov2(weights, "cpu")
        assert "facebook/dinov2-small" in refused.value.remedy


def test_missing_library_is_refused_with_a_remedy(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "transformers", None)
    with pytest.raises(InputError, match="MOD-002") as refused:
        checkpoints.library()
    assert refused.value.remedy == "make extras"
