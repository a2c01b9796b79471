"""LPIPS with small random weights in the published format."""

from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.core.errors import InputError
from pipeline.metrics.lpips import ALEXNET_FILE, CHANNELS_FILE, CONVOLUTIONS, Lpips

RNG = np.random.default_rng(0)


def write_weights(folder: Path) -> None:
    """Write random weights in the published format of both files."""
    generator, inner, features = torch.Generator().manual_seed(0), 3, {}
    for index, channels, kernel, *_ in CONVOLUTIONS:
        shape = (channels, inner, kernel, kernel)
        features[f"features.{index}.weight"] = 0.05 * torch.randn(shape, generator=generator)
        features[f"features.{index}.bias"] = torch.zeros(channels)
        inner = channels
    features["classifier.1.weight"] = torch.zeros(4, 4)  # the file of torchvision has further weights
    torch.save(features, folder / ALEXNET_FILE)
    lin = {f"lin{n}.model.1.weight": torch.rand(1, each[1], 1, 1) for n, each in enumerate(CONVOLUTIONS)}
    torch.save(lin, folder / CHANNELS_FILE)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    write_weights(tmp_path)
    return tmp_path


def test_distance_increases_with_noise_and_is_local(weights: Path):
    model, true = Lpips.load(weights), RNG.uniform(0, 1, (96, 128, 3))
    assert model.distance(true, true).max() == 0
    noise = RNG.normal(0, 1, true.shape)
    distances = [model.distance(np.clip(true + share * noise, 0, 1), true).mean() for share in (0.05, 0.2)]
    assert 0 < distances[0] < distances[1]
    left = true.copy()
    left[:, :32] = 0.5
    where = model.distance(left, true).mean(0)
    assert where[:24].mean() > 5 * where[-32:].mean()


def test_distance_equals_the_published_formula(weights: Path):
    """Compares with the explicit formula: the mean over positions of weighted squared differences of unit
    features.
    """
    model, pair = Lpips.load(weights), RNG.uniform(0, 1, (2, 127, 127, 3))
    images = [torch.as_tensor(image, dtype=torch.float32).permute(2, 0, 1)[None] for image in pair]
    expected = sum(
        float(((a - b) ** 2 * weight[:, None, None]).sum(1).mean())
        for a, b, weight in zip(*(model.features(image) for image in images), model.weights, strict=True)
    )
    assert [feature.shape[-1] for feature in model.features(images[0])] == [31, 15, 7, 7, 7]
    assert model.distance(*pair).mean() == pytest.approx(expected, rel=0.05), "up to interpolation"


def test_small_pictures_are_not_measured(weights: Path):
    assert np.isnan(Lpips.load(weights).distance(np.zeros((40, 90, 3)), np.zeros((40, 90, 3)))).all()


def test_missing_and_wrong_weights_are_refused(weights: Path, tmp_path: Path):
    with pytest.raises(InputError, match="MOD-001"):
        Lpips.load(tmp_path / "nowhere")
    torch.save({"features.0.weight": torch.zeros(3)}, weights / ALEXNET_FILE)
    with pytest.raises(InputError, match="MOD-003"):
        Lpips.load(weights)
    (weights / ALEXNET_FILE).write_bytes(b"no archive")
    with pytest.raises(InputError, match="MOD-003"):
        Lpips.load(weights)
