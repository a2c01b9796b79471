"""A stand-in for gsplat: the signature of the pinned version, drawn by the reference rasterizer."""

import inspect
import sys
from types import ModuleType, SimpleNamespace

import pytest
import torch

from pipeline.fields.footprints import BLUR_PX2, NEAREST_M
from tests.pipeline.fields import dense_rasterizer

VERSION = "1.5.3"
REQUIRED = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height")
OPTIONAL = (
    "near_plane", "far_plane", "radius_clip", "eps2d", "sh_degree", "packed", "tile_size", "backgrounds",
    "render_mode", "sparse_grad", "absgrad", "rasterize_mode", "channel_chunk", "distributed", "camera_model",
    "segmented", "covars", "with_ut", "with_eval3d", "radial_coeffs", "tangential_coeffs", "thin_prism_coeffs",
    "ftheta_coeffs", "rolling_shutter", "viewmats_rs",
)  # fmt: skip
"""Parameters of `gsplat.rasterization` without and with a default, in order."""
SIGNATURE = inspect.Signature(
    [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in REQUIRED]
    + [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=None) for name in OPTIONAL]
)


def rasterization(*positional, **named) -> tuple[torch.Tensor, torch.Tensor, dict]:
    """Draw as gsplat does; refuse arguments that it refuses or that it would take otherwise."""
    given = SimpleNamespace(**SIGNATURE.bind(*positional, **named).arguments)
    points = len(given.means)
    shapes = {"means": (points, 3), "quats": (points, 4), "scales": (points, 3), "opacities": (points,)}
    shapes |= {"viewmats": (1, 4, 4), "Ks": (1, 3, 3)}
    for name, shape in shapes.items():
        assert getattr(given, name).shape == shape, name
        assert getattr(given, name).dtype == torch.float32, name
    assert given.colors.shape[0] == points and given.colors.ndim == 2
    assert (type(given.width), type(given.height)) == (int, int)
    assert (given.near_plane, given.eps2d) == (NEAREST_M, BLUR_PX2), "those of the other rasterizers"
    image, coverage = dense_rasterizer.draw(
        given.means, given.quats, given.scales.log(), given.opacities, given.colors, given.viewmats[0], given.Ks[0],
        given.height, given.width,
    )  # fmt: skip
    return image[None], coverage[None, ..., None], {}


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `pipeline.fields.rasterize` find the stand-in and a CUDA device."""
    package, backend = ModuleType("gsplat"), ModuleType("gsplat.cuda._backend")
    package.rasterization, backend._C = rasterization, object()
    monkeypatch.setitem(sys.modules, "gsplat", package)
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", backend)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
