"""SMPL-X bodies through the `smplx` package, for users who have its model files.

`smplx_body` reads a person's surface with joints as bones; `motion_from_parameters` turns recorded SMPL-X
parameters, including hands, into motion of that body. Pose blend shapes and faces are left out: the surface
moves by linear blend skinning alone.
"""

import importlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from pipeline.longterm.bodies import SkinnedBody
from pipeline.longterm.short_motions import BodyMotion

SHAPES = 10
"""number of betas in the paper"""
SURFACE = ("v_template", "f", "weights", "J_regressor", "kintree_table", "shapedirs")
HANDS = ("hands_meanl", "hands_meanr", "hands_componentsl", "hands_componentsr")
BODY, FACE, HAND = 63, 9, 45
"""lengths of the rotation vectors of the body's joints, of jaw and eyes, and of one hand's joints"""


@dataclass(frozen=True)
class Person:
    """A body and its kinematic tree."""

    body: SkinnedBody
    parent: Int[np.ndarray, "bone"]
    """parent bones; -1 for the pelvis"""
    pelvis: Float[np.ndarray, "3"]
    """position of the pelvis at rest in the frame of SMPL-X, meters"""
    hand_mean: Float[np.ndarray, "hand 45"]
    """mean pose of the left and the right hand, rotation vectors"""
    hand_components: Float[np.ndarray, "hand component 45"]
    """principal components of the hands' poses"""


def smplx_body(model: Path, betas: Float[np.ndarray, "shape"] | None = None) -> Person:
    """Read an SMPL-X model file (npz) with betas. The agent frame is the pelvis at rest, +y up, +z ahead.

    Raises InputError LTM-003 without the package, LTM-004 for a missing file or one that is not SMPL-X.
    """
    try:
        smplx, lbs = importlib.import_module("smplx"), importlib.import_module("smplx.lbs")
    except ImportError as error:
        remedy = "install it beside the others: .venv/bin/pip install --no-deps smplx"
        raise InputError("LTM-003", "SMPL-X bodies need the package smplx", str(model), remedy) from error
    if not model.is_file():
        remedy = "get SMPLX_NEUTRAL.npz from its authors' site"
        raise InputError("LTM-004", "there is no such SMPL-X model", str(model), remedy)
    file = npz.load(model, (*SURFACE, *HANDS))
    try:
        layer = smplx.SMPLXLayer(str(model), ext="npz", num_betas=SHAPES, use_pca=False)
    except (KeyError, AttributeError, ValueError, RuntimeError, AssertionError, IndexError) as error:
        what = f"not a model of SMPL-X: {error!r}"
        raise InputError("LTM-004", what, str(model), "give SMPLX_NEUTRAL.npz as it came") from error
    shape = np.zeros(SHAPES) if betas is None else np.asarray(betas, float)[:SHAPES]
    with torch.no_grad():
        basis = layer.shapedirs[:, :, : len(shape)]
        surface = layer.v_template[None] + lbs.blend_shapes(torch.from_numpy(shape).to(basis)[None], basis)
        joints = lbs.vertices2joints(layer.J_regressor, surface)[0].double().numpy()
    vertices = surface[0].numpy() - joints[0].astype(np.float32)
    rest = rigid.make(np.eye(3)[None], joints - joints[0])
    mesh = Mesh(vertices, np.asarray(layer.faces, np.int32))
    parent = layer.parents.numpy().astype(np.int64).copy()
    parent[0] = -1
    body = SkinnedBody(mesh, layer.lbs_weights.double().numpy(), rest, shape)
    mean, components = (np.stack([file[name] for name in names]) for names in (HANDS[:2], HANDS[2:]))
    return Person(body, parent, joints[0], mean, components)


def motion_from_parameters(
    person: Person,
    transl: Float[np.ndarray, "frame 3"],
    global_orient: Float[np.ndarray, "frame 3"],
    body_pose: Float[np.ndarray, "frame 63"],
    hands: Float[np.ndarray, "frame hand coefficient"] | None = None,
) -> BodyMotion:
    """Return the motion of SMPL-X parameters: rotation vectors of the pelvis and of the body's joints.

    ``hands`` are rotation vectors (45 values) or PCA coefficients (fewer) of the left and the right hand; by
    default hands rest. SMPL-X rotates a body about its pelvis, which is not at its origin; the root includes
    that offset.
    """
    frames, rest = len(transl), person.body.agent_from_bone_rest
    vectors = np.zeros((frames, len(rest), 3))
    vectors[:, 1 : 1 + BODY // 3] = np.asarray(body_pose, float).reshape(frames, -1, 3)
    if hands is not None:
        if hands.shape[-1] < HAND:
            basis = person.hand_components[:, : hands.shape[-1]]
            hands = person.hand_mean + np.einsum("fhc,hcj->fhj", hands, basis)
        vectors[:, 1 + (BODY + FACE) // 3 :] = np.asarray(hands, float).reshape(frames, -1, 3)
    local = rigid.rotation_from_vector(vectors)
    bones = np.broadcast_to(np.eye(4), (frames, len(rest), 4, 4)).copy()
    for bone in range(1, len(rest)):
        parent = person.parent[bone]
        offset = rest[bone, :3, 3] - rest[parent, :3, 3]
        bones[:, bone] = bones[:, parent] @ rigid.make(local[:, bone], np.broadcast_to(offset, (frames, 3)))
    pelvis = np.asarray(transl, float) + person.pelvis
    root = rigid.make(rigid.rotation_from_vector(np.asarray(global_orient, float)), pelvis)
    return BodyMotion(root, bones)
