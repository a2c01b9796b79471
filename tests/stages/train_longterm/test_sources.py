from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.data import ply
from stages.train_longterm import sources, stage
from stages.train_longterm.config import Config
from tests.pipeline.longterm import strider
from tests.pipeline.longterm.test_smplx_bodies import write_model


def test_people_are_read(tmp_path):
    pytest.importorskip("smplx")
    rng = np.random.default_rng(0)
    ply.write_ply(tmp_path / "scene.ply", strider.room())
    for name in ("a", "b"):
        np.savez(
            tmp_path / f"{name}.npz",
            timestamp_s=np.arange(40) / 15,
            transl=np.tile([1.0, 1.0, 1.0], (40, 1)),
            betas=np.zeros(10),
            global_orient=np.zeros((40, 3)),
            body_pose=rng.normal(0, 0.01, (40, 63)),
        )
    (tmp_path / "model").mkdir()
    parted = sources.people(write_model(tmp_path / "model" / "SMPLX_NEUTRAL.npz"), tmp_path)
    assert [len(motion) for motion in parted.train.stretches] == [79]
    assert len(parted.held_out.stretches) == 1
    assert parted.train.body.shape.shape == (10,)


def test_missing_people_are_refused(tmp_path):
    with pytest.raises(InputError, match="LTM-001"):
        sources.people(tmp_path / "model.npz", tmp_path)


@pytest.mark.parametrize("half", [{"smplx_model": "model.npz"}, {"smplx_motions": "motions"}])
def test_half_of_the_settings_of_people_is_refused(half, tmp_path):
    with pytest.raises(InputError, match="REC-002"):
        stage.run(stage.Inputs(), Config(**half), tmp_path)


def test_people_of_two_seconds_or_less_are_refused(tmp_path, monkeypatch):
    known = strider.dataset(count=1)
    motion, person = known.stretches[0][:61], SimpleNamespace(body=known.body)
    monkeypatch.setattr(sources, "smplx_body", lambda *_: person)
    monkeypatch.setattr(sources, "motion_from_parameters", lambda *_, **__: motion)
    ply.write_ply(tmp_path / "scene.ply", strider.room())
    names, fits = ("transl", "global_orient", "body_pose", "betas"), np.zeros((61, 3))
    for frames, code in ((60, "LTM-001"), (61, None)):
        when = np.arange(61) / 30 * (frames - 1) / 60
        np.savez(tmp_path / "a.npz", timestamp_s=when, **{name: fits for name in names})
        with pytest.raises(InputError, match=code) if code else nullcontext():
            assert len(sources.people(tmp_path / "model.npz", tmp_path).train.stretches) == 1
