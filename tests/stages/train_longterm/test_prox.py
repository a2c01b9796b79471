"""A small folder in the format of PROX: a scan with z up, its signed distances, and body fits in the camera."""

import json
import os
import pickle

import numpy as np
import pytest
import torch

from pipeline.core.errors import InputError
from pipeline.geometry import rigid
from stages.train_longterm import prox, sources
from tests.pipeline.longterm import strider
from tests.pipeline.longterm.test_smplx_bodies import write_model

SCAN_FROM_WORLD = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""scans of PROX have z up"""


def write_prox(folder, frames=80, takes=("Room_00001_01", "Room_00001_02")):
    trimesh = pytest.importorskip("trimesh")
    room = strider.room()
    scan_from_camera = SCAN_FROM_WORLD @ rigid.make(
        rigid.rotation_from_vector(np.array([0.3, 0.2, 0.1])), np.array([0.5, 1.0, -0.4])
    )
    for name in ("scenes", "sdf", "cam2world"):
        (folder / name).mkdir(parents=True)
    (folder / "cam2world" / "Room.json").write_text(json.dumps(scan_from_camera.tolist()))
    mesh = trimesh.Trimesh(rigid.apply(SCAN_FROM_WORLD, np.asarray(room.vertices)), room.faces, process=False)
    mesh.export(folder / "scenes" / "Room.ply")
    low, high = mesh.vertices.min(0) - 0.5, mesh.vertices.max(0) + 0.5
    axes = [np.linspace(low[axis], high[axis], 24) for axis in range(3)]
    height = np.stack(np.meshgrid(*axes, indexing="ij"), -1)[..., 2]
    np.save(folder / "sdf" / "Room_sdf.npy", height - mesh.vertices[:, 2].min())
    (folder / "sdf" / "Room.json").write_text(
        json.dumps({"min": low.tolist(), "max": high.tolist(), "dim": 24})
    )
    upright = rigid.inverse(scan_from_camera @ np.eye(4))[:3, :3] @ SCAN_FROM_WORLD[:3, :3]
    for take in takes:
        for number in range(frames):
            frame = (
                folder / prox.FITS / take / "results" / f"s001_frame_{number:05d}__00.00.{number / 30:06.3f}"
            )
            frame.mkdir(parents=True)
            place = rigid.apply(
                rigid.inverse(scan_from_camera) @ SCAN_FROM_WORLD,
                np.array([[1.0 + 0.005 * number, 1.0, 1.0]]),
            )
            fit = {
                "transl": place.astype(np.float32),
                "global_orient": rigid.vector_from_rotation(upright[None]).astype(np.float32),
                "body_pose": np.zeros((1, 63), np.float32),
                "left_hand_pose": np.full((1, 12), 0.1, np.float32),
                "right_hand_pose": np.zeros((1, 12), np.float32),
                "betas": np.zeros((1, 10), np.float32),
            }
            (frame / "000.pkl").write_bytes(pickle.dumps(fit, protocol=2))
    return folder


@pytest.fixture
def model(tmp_path):
    pytest.importorskip("smplx")
    (tmp_path / "model").mkdir()
    return write_model(tmp_path / "model" / "SMPLX_NEUTRAL.npz", standing=True)


def test_prox_is_read_upright_with_hands_and_distances(tmp_path, model):
    split = sources.people(model, write_prox(tmp_path / "prox"))
    assert len(split.train.stretches) == len(split.held_out.stretches) == 1
    motion, scene = split.train.stretches[0], split.train.scenes[0]
    root = motion.world_from_agent
    assert len(root) in (79, 80), "PROX's clock counts thousandths"
    np.testing.assert_allclose(root[0, :3, :3] @ [0, 1, 0], [0, 1, 0], atol=1e-5)
    assert root[:, 1, 3] == pytest.approx(root[0, 1, 3], abs=1e-5)
    assert np.linalg.norm(root[-1, :3, 3] - root[0, :3, 3]) == pytest.approx(0.395, abs=0.006)
    left, right = motion.agent_from_bone[0, 25:40, :3, :3], motion.agent_from_bone[0, 40:55, :3, :3]
    assert not np.allclose(left, np.eye(3), atol=1e-3) and not np.allclose(right, np.eye(3), atol=1e-3)
    floor = np.asarray(scene.mesh.vertices)[:, 1].min()
    above = scene.distance.at(torch.tensor([[1.0, floor + 0.3, 1.0]]))
    assert float(above) == pytest.approx(0.3, abs=0.02)


def test_missing_distances_are_computed(tmp_path, model):
    folder = write_prox(tmp_path / "prox")
    (folder / "sdf" / "Room_sdf.npy").unlink()
    scene = sources.people(model, folder).train.scenes[0]
    assert scene.known is None and torch.isfinite(scene.distance.values).all()


def test_gap_ends_a_segment(tmp_path, model):
    folder = write_prox(tmp_path / "prox", frames=160, takes=("Room_00001_01",))
    for number in range(70, 90):
        (folder / prox.FITS / "Room_00001_01" / "results").joinpath(
            f"s001_frame_{number:05d}__00.00.{number / 30:06.3f}", "000.pkl"
        ).unlink()
    split = sources.people(model, folder)
    assert [len(motion) for motion in split.train.stretches] == [70, 70] and split.held_out is None


class _Command:
    def __reduce__(self):
        return os.system, ("true",)


@pytest.mark.parametrize(
    "harm",
    [
        lambda folder, fit: fit.write_bytes(pickle.dumps(_Command())),
        lambda folder, fit: fit.write_bytes(b"\x80\x02"),
        lambda folder, fit: fit.write_bytes(pickle.dumps({"transl": np.zeros((1, 3))})),
        lambda folder, fit: (folder / "cam2world" / "Room.json").unlink(),
        lambda folder, fit: (folder / "scenes" / "Room.ply").write_bytes(b"ply"),
        lambda folder, fit: (folder / "sdf" / "Room_sdf.npy").write_bytes(b"\x93NUMPY"),
    ],
    ids=["a command", "cut off", "another table", "no camera", "no scan", "no grid"],
)
def test_damaged_files_are_refused(tmp_path, model, harm):
    folder = write_prox(tmp_path / "prox", takes=("Room_00001_01",))
    harm(folder, next((folder / prox.FITS).rglob("000.pkl")))
    with pytest.raises(InputError, match="LTM-005"):
        sources.people(model, folder)
