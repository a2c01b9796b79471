import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.data import ply
from stages.train_longterm import sources
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
