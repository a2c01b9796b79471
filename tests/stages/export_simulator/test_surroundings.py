"""The page for another home shows that home, starts from the take in it, and reports how unfamiliar it is."""

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.data import npz
from stages.export_simulator import stage, surroundings
from stages.export_simulator.config import Config


def take(folder: Path, frames: int = 20) -> Path:
    """Write a take beside an observer at (1, 1.4, 0)."""
    folder.mkdir()
    root = np.tile(np.eye(4), (frames, 1, 1))
    root[:, 2, 3] = np.linspace(0, 1, frames)
    npz.save(
        folder / "take.npz",
        timestamp_s=np.arange(frames) / 10,
        world_from_agent=root,
        agent_from_bone=np.tile(np.eye(4, dtype=np.float32), (frames, 3, 1, 1)),
        observer_world=np.tile([1.0, 1.4, 0.0], (frames, 1)),
    )
    (folder / "home.json").write_text(json.dumps({"home": "other", "share_known": 0.42}))
    return folder


def home(folder: Path) -> Path:
    """Write the files of a home without content."""
    for name in ("reconstruction", "splats"):
        (folder / name).mkdir(parents=True)
        (folder / name / "scene.ply").touch()
    return folder


def test_take_in_another_home_is_the_motion_of_the_page(tmp_path: Path) -> None:
    place = surroundings.elsewhere(home(tmp_path / "other"), take(tmp_path / "take"), "luna")
    assert place.surface == tmp_path / "other/reconstruction/scene.ply"
    assert place.volume == tmp_path / "take/volume.npz"
    assert place.remark is not None and "42%" in place.remark and "luna" in place.remark
    (clip,) = place.motions
    looks = clip.world_from_camera[:, :3, 2]
    towards = clip.world_from_agent[:, :3, 3] - [1.0, 1.4, 0.0]
    np.testing.assert_allclose(looks, towards / np.linalg.norm(towards, axis=1, keepdims=True), atol=1e-9)
    assert place.labels == {clip.name: "a take in the home of other"}


def test_missing_files_are_named(tmp_path: Path) -> None:
    made = take(tmp_path / "take")
    with pytest.raises(InputError, match="ART-003.*reconstruction"):
        surroundings.elsewhere(tmp_path, made, "luna")
    (made / "home.json").unlink()
    with pytest.raises(InputError, match="EXP-003"):
        surroundings.elsewhere(home(tmp_path / "other"), made, "luna")
    inputs = stage.Inputs(tmp_path, tmp_path, tmp_path, tmp_path, home=tmp_path)
    with pytest.raises(InputError, match="EXP-003"):
        stage.run(inputs, Config(), tmp_path)
