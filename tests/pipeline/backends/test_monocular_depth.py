"""Monocular depth backends agree with transformers on small checkpoints with random weights."""

import numpy as np
import pytest

from pipeline.backends.monocular_depth import MonocularDepth
from pipeline.core.errors import InputError
from tests.pipeline.backends import small_checkpoints

COLOR = np.random.default_rng(0).integers(0, 255, (90, 66, 3), dtype=np.uint8)


@pytest.mark.parametrize("kind", ["relative", "metric"])
def test_depth_anything_equals_transformers(kind, tmp_path):
    path = small_checkpoints.depth_anything(tmp_path, kind)
    import torch
    import transformers

    ours = MonocularDepth("depth_anything_v2", str(path), "cpu").inverse_depth(COLOR)
    assert max(ours.shape) == 518 and ours.shape[1] % 14 == 0
    network = transformers.DepthAnythingForDepthEstimation.from_pretrained(path).eval()
    from PIL import Image

    small = Image.fromarray(COLOR).resize(ours.shape[::-1], Image.Resampling.BICUBIC)
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    pixels = ((np.asarray(small) / 255 - mean) / std).transpose(2, 0, 1)[None].astype(np.float32)
    with torch.no_grad():
        theirs = network(pixel_values=torch.from_numpy(pixels)).predicted_depth[0].numpy()
    expected = theirs if kind == "relative" else 1 / np.maximum(theirs, 0.05)
    np.testing.assert_allclose(ours, expected, rtol=1e-3, atol=1e-4)


def test_depth_pro_is_finite_everywhere(tmp_path):
    path = small_checkpoints.depth_pro(tmp_path)
    found = MonocularDepth("depth_pro", str(path), "cpu").inverse_depth(COLOR)
    assert found.shape[0] == found.shape[1] and np.isfinite(found).all() and np.ptp(found) > 0


def test_missing_and_other_checkpoints_are_refused(tmp_path):
    small_checkpoints.library()
    with pytest.raises(InputError, match="MOD-001"):
        MonocularDepth("depth_pro", str(tmp_path), "cpu")
