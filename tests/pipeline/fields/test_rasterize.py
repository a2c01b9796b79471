"""The tile rasterizer agrees with the dense reference in values and gradients, and is deterministic."""

import math
from functools import partial

import pytest
import torch

from pipeline.fields import rasterize
from tests.pipeline.fields import dense_rasterizer

HEIGHT, WIDTH = 20, 27
INTRINSICS = torch.tensor([[25.0, 0, 13], [0, 25.0, 10], [0, 0, 1]])


def cloud(points: int = 60):
    generator = torch.Generator().manual_seed(1)
    means = torch.rand(points, 3, generator=generator) * torch.tensor([2.4, 2.0, 2.0]) - torch.tensor(
        [1.2, 1.0, -1.0]
    )
    rotation = torch.randn(points, 4, generator=generator)
    log_scale = math.log(0.12) + 0.4 * torch.randn(points, 3, generator=generator)
    opacity = 0.05 + 0.9 * torch.rand(points, generator=generator)
    values = torch.rand(points, 5, generator=generator)
    return [tensor.requires_grad_() for tensor in (means, rotation, log_scale, opacity, values)]


def rendered(draw=rasterize.draw, device: str = "cpu"):
    parameters = cloud()
    moved = [part.to(device) for part in (*parameters, torch.eye(4), INTRINSICS)]
    image, coverage = (part.cpu() for part in draw(*moved, HEIGHT, WIDTH))
    generator = torch.Generator().manual_seed(2)
    weight = torch.rand(image.shape, generator=generator)
    ((image - weight).square().mean() + (coverage * weight[..., 0]).mean()).backward()
    return image.detach(), coverage.detach(), [parameter.grad for parameter in parameters]


@pytest.mark.parametrize("backend", ["tiles", "gsplat"])
def test_rasterizers_agree_with_the_reference(backend):
    if backend == "gsplat":
        pytest.importorskip("gsplat")
    image, coverage, grads = rendered(
        partial(rasterize.draw, backend=backend), "cuda" if backend == "gsplat" else "cpu"
    )
    reference_image, reference_coverage, reference_grads = rendered(dense_rasterizer.draw)
    assert 0.3 < reference_coverage.mean() < 0.99, "the scene must neither be empty nor closed"
    torch.testing.assert_close(image, reference_image, rtol=1e-4, atol=2e-4)
    torch.testing.assert_close(coverage, reference_coverage, rtol=1e-4, atol=2e-4)
    for name, found, expected in zip(
        ("means", "rotation", "scale", "opacity", "values"), grads, reference_grads, strict=True
    ):
        error = (found - expected).abs().max() / expected.abs().max()
        assert error < 1e-4, f"{name}: relative error {error:.1e}"


def test_rendering_is_deterministic():
    first, second = rendered(), rendered()
    assert torch.equal(first[0], second[0]) and all(
        torch.equal(a, b) for a, b in zip(first[2], second[2], strict=True)
    )


def test_occluded_gaussians_and_those_behind_the_camera_are_invisible():
    means = torch.tensor([[0.0, 0, -1], [0, 0, 1], [0, 0, 2]])
    rotation, log_scale = torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1), torch.full((3, 3), math.log(0.3))
    values = torch.eye(3)
    image, _ = rasterize.draw(
        means, rotation, log_scale, torch.full((3,), 0.98), values, torch.eye(4), INTRINSICS, HEIGHT, WIDTH
    )
    assert image[10, 13, 0] == 0 and image[10, 13, 1] > 0.95 and image[10, 13, 2] < 0.03


def test_gsplat_is_refused_without_cuda():
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    from pipeline.core.errors import InputError

    with pytest.raises(InputError, match="DEP-001|gsplat"):
        rasterize.draw(*cloud(3), torch.eye(4), INTRINSICS, HEIGHT, WIDTH, "gsplat")
