"""The feature basis is fitted on training recordings only and applied to every video."""

import json
import sys

import cv2
import numpy as np
import pytest

from pipeline.backends.daisy import FeatureBasis, describe
from pipeline.data import images, npz
from pipeline.workflow import artifact, cli
from stages.extract_features import stage as extract
from stages.fit_feature_basis import stage as fit
from tests.stages.written_frames import write_frames

ROLES = ("walkthrough", "turnaround", "session", "session")


def _write_clip(folder, seed):
    rng = np.random.default_rng(seed)
    with artifact.create(folder, stage="extract_frames", config={}, inputs={}, key=None) as inside:
        small = [rng.integers(0, 255, (24, 18, 3), dtype=np.uint8) for _ in range(3)]
        pictures = [cv2.resize(each, (78, 101)) for each in small]  # not a multiple of the cell size
        write_frames(inside, pictures, np.ones((8, 6)))


@pytest.fixture
def world(tmp_path):
    """Four recordings; the last is the test video."""
    videos = []
    for i, role in enumerate(ROLES):
        _write_clip(tmp_path / "frames" / f"v{i:03d}", seed=i)
        split = "test" if i == 3 else "train" if role == "session" else "none"
        videos.append(
            {
                "id": f"v{i:03d}",
                "file": f"{i}.r3d",
                "role": role,
                "split": split,
                "sha256": "",
                "synchronized_with": None,
                "offset_s": 0.0,
            }
        )
    (tmp_path / "videos.json").write_text(json.dumps(videos))
    return tmp_path


def _fit(world, monkeypatch, out):
    argv = [
        "fit_feature_basis/__main__.py",
        "--frames",
        world / "frames",
        "--videos",
        world / "videos.json",
        "--out",
        out,
    ]
    monkeypatch.setattr(sys, "argv", [str(part) for part in argv])
    cli.main("Fit.", fit.run, fit.Inputs, fit.Config)


def test_basis_ignores_the_test_video_and_projects_its_features(world, monkeypatch):
    _fit(world, monkeypatch, world / "basis")
    before = (world / "basis" / "basis.npz").read_bytes()
    test_video = world / "frames" / "v003"
    for i in range(3):
        images.write_color(test_video / "color" / f"{i:06d}.jpg", np.zeros((101, 78, 3), np.uint8))
    _fit(world, monkeypatch, world / "again")
    assert (world / "again" / "basis.npz").read_bytes() == before
    (world / "features").mkdir()
    inputs = extract.Inputs(frames=world / "frames" / "v002", feature_basis=world / "basis")
    extract.run(inputs, extract.Config(), world / "features")
    features = npz.load(world / "features" / "features.npz")["features"]
    assert features.shape == (3, 12, 9, 16)
    assert features.dtype == np.float16
    color = images.read_color(world / "frames" / "v002" / "color" / "000001.jpg")
    np.testing.assert_allclose(
        features[1], FeatureBasis.load(world / "basis").project(describe(color, 8)), atol=1e-3
    )
