import sys

import numpy as np
import pytest
import torch

from pipeline.core.errors import InputError
from pipeline.geometry import rigid
from pipeline.longterm.bodies import PosedSurface
from pipeline.longterm.smplx_bodies import motion_from_parameters, smplx_body

VERTICES, JOINTS = 120, 55


def write_model(path, *, standing=False):
    """Write a model file in the official format with a random surface on the tree of 55 joints; the neck is
    above the pelvis if ``standing``.
    """
    rng = np.random.default_rng(0)
    parents = np.concatenate([[2**32 - 1], [int(rng.integers(0, joint)) for joint in range(1, JOINTS)]])
    regressor = rng.dirichlet(np.ones(VERTICES) * 0.05, JOINTS)
    vertices = rng.normal(0, 0.4, (VERTICES, 3))
    if standing:
        vertices[:, 1] += 5.0 * (regressor[12] - regressor[0])
    faces = rng.permuted(np.tile(np.arange(VERTICES), (80, 1)), axis=1)[:, :3]
    np.savez(
        path,
        v_template=vertices,
        f=faces.astype(np.uint32),
        weights=rng.dirichlet(np.ones(JOINTS) * 0.1, VERTICES),
        J_regressor=regressor,
        kintree_table=np.stack([parents, np.arange(JOINTS)]).astype(np.int64),
        shapedirs=rng.normal(0, 0.01, (VERTICES, 3, 400)),
        posedirs=np.zeros((VERTICES, 3, 9 * (JOINTS - 1))),
        hands_componentsl=rng.normal(0, 0.3, (45, 45)),
        hands_componentsr=rng.normal(0, 0.3, (45, 45)),
        hands_meanl=rng.normal(0, 0.1, 45),
        hands_meanr=rng.normal(0, 0.1, 45),
        lmk_faces_idx=np.zeros(51, np.int64),
        lmk_bary_coords=np.full((51, 3), 1 / 3),
    )
    return path


def test_missing_package_and_file_are_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "smplx", None)
    with pytest.raises(InputError, match="LTM-003"):
        smplx_body(tmp_path / "none.npz")


def test_wrong_files_are_refused(tmp_path):
    pytest.importorskip("smplx")
    with pytest.raises(InputError, match="LTM-004"):
        smplx_body(tmp_path / "none.npz")
    np.savez(tmp_path / "other.npz", v_template=np.zeros((3, 3)))
    with pytest.raises(InputError, match="ART-010"):
        smplx_body(tmp_path / "other.npz")


def test_skinning_equals_that_of_smplx(tmp_path):
    smplx = pytest.importorskip("smplx")
    path = write_model(tmp_path / "SMPLX_NEUTRAL.npz")
    rng = np.random.default_rng(1)
    betas, transl, turn = rng.normal(size=10), rng.normal(size=(4, 3)), rng.normal(0, 0.5, (4, 3))
    pose = rng.normal(0, 0.4, (4, 63))
    person = smplx_body(path, betas)
    assert person.body.agent_from_bone_rest.shape == (JOINTS, 4, 4)
    posed = PosedSurface(person.body)(*motion_from_parameters(person, transl, turn, pose).tensors()).numpy()
    layer = smplx.SMPLXLayer(str(path), ext="npz", num_betas=10, use_pca=False)
    layer.vertex_joint_selector.extra_joints_idxs = torch.zeros(
        0, dtype=torch.long
    )  # they index vertices that only the real model has
    rotation = torch.from_numpy(
        rigid.rotation_from_vector(np.concatenate([turn, pose], axis=1).reshape(4, 22, 3))
    ).float()
    theirs = (
        layer(
            betas=torch.from_numpy(betas).float()[None].expand(4, -1),
            global_orient=rotation[:, :1],
            body_pose=rotation[:, 1:],
            transl=torch.from_numpy(transl).float(),
        )
        .vertices.detach()
        .numpy()
    )
    np.testing.assert_allclose(theirs, posed, atol=2e-5)
