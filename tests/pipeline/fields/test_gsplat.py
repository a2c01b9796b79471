"""gsplat is called as its pinned version wants it; the signature is read without CUDA."""

import ast
import tomllib
from importlib import metadata, util
from pathlib import Path

import pytest
import torch

from pipeline.core.errors import InputError
from pipeline.fields import rasterize
from tests.pipeline.fields import dense_rasterizer, gsplat_stand_in
from tests.pipeline.fields.gsplat_stand_in import OPTIONAL, REQUIRED, VERSION
from tests.pipeline.fields.test_rasterize import HEIGHT, INTRINSICS, WIDTH, cloud

ROOT = Path(__file__).parents[3]


def test_call_fits_the_pinned_version(monkeypatch):
    gsplat_stand_in.install(monkeypatch)
    camera = torch.eye(4), INTRINSICS, HEIGHT, WIDTH
    with torch.no_grad():
        for ours, expected in zip(
            rasterize.draw(*cloud(), *camera, "gsplat"), dense_rasterizer.draw(*cloud(), *camera), strict=True
        ):
            torch.testing.assert_close(ours, expected)


def test_arguments_that_are_no_longer_known_are_refused():
    with pytest.raises(TypeError, match="ortho"):
        gsplat_stand_in.rasterization(*[None] * len(REQUIRED), ortho=True)


def test_one_version_is_pinned():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert extras["gsplat"] == [f"gsplat=={VERSION}"]
    assert f"pip install --no-deps gsplat=={VERSION} " in (ROOT / "docs/gpu_and_cluster.md").read_text()
    assert f"pip install gsplat=={VERSION}" in Path(rasterize.__file__).read_text()


def test_signature_is_that_of_the_installed_version():
    found = util.find_spec("gsplat")
    if found is None:
        pytest.skip("gsplat is not installed")
    assert metadata.version("gsplat") == VERSION
    tree = ast.parse(Path(found.submodule_search_locations[0], "rendering.py").read_text())
    (function,) = (node for node in tree.body if getattr(node, "name", "") == "rasterization")
    names = tuple(argument.arg for argument in function.args.args)
    assert names == REQUIRED + OPTIONAL and len(function.args.defaults) == len(OPTIONAL)


def test_missing_gsplat_is_refused(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gsplat", None)
    with pytest.raises(InputError, match="DEP-001") as refused:
        rasterize.draw(*cloud(3), torch.eye(4), INTRINSICS, HEIGHT, WIDTH, "gsplat")
    assert f"gsplat=={VERSION}" in refused.value.remedy
