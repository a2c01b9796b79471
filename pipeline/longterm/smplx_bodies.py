"""People as bodies: SMPL-X through the `smplx` package, for those who have its model files.

`smplx_body` gives the surface of one person, its joints as bones; `motion_from_parameters` turns recorded
SMPL-X parameters, hands included, into motion of that body. Corrective blend shapes and faces are left out:
skinning alone moves the surface.
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
"""betas of the paper"""
# What is read of a model file.
SURFACE = ("v_template", "f", "weights", "J_regressor", "kintree_table", "shapedirs")
HANDS = ("hands_meanl", "hands_meanr", "hands_componentsl", "hands_componentsr")
BODY, FACE, HAND = 63, 9, 45
"""numbers of rotation vectors: of the body's joints, of jaw and eyes, of one hand's joints"""


@dataclass(frozen=True)
class Person:
    """A body and the tree of its joints."""

    body: SkinnedBody
    parent: Int[np.ndarray, "bone"]
    """bone above each; -1 of the pelvis"""
    pelvis: Float[np.ndarray, "3"]
    """where the pelvis is at rest in the frame of SMPL-X, metres"""
    hand_mean: Float[np.ndarray, "hand 45"]
    """pose of the left and the right hand without coefficients, rotation vectors"""
    hand_components: Float[np.ndarray, "hand component 45"]
    """what one of their coefficients adds"""


def smplx_body(model: Path, betas: Float[np.ndarray, "shape"] | None = None) -> Person:
    """Read an SMPL-X model file (npz) and shape it. The agent frame is the pelvis at rest, +y up, +z ahead.

    Raises InputError LTM-003 where the package is missing, LTM-004 where the file is, or is none of SMPL-X.
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
        known = layer.shapedirs[:, :, : len(shape)]
        surface = layer.v_template[None] + lbs.blend_shapes(torch.from_numpy(shape).to(known)[None], known)
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
    """Return motion of SMPL-X parameters: rotation vectors of the pelvis and of the body's joints.

    ``hands`` are rotation vectors (45 numbers) or principal coefficients (fewer) of the left and the right
    hand; without them hands rest. SMPL-X turns a body about its pelvis at rest, which stands away from its
    origin: the root carries both.
    """
    frames, rest = len(transl), person.body.agent_from_bone_rest
    turn = np.zeros((frames, len(rest), 3))
    turn[:, 1 : 1 + BODY // 3] = np.asarray(body_pose, float).reshape(frames, -1, 3)
    if hands is not None:
        if hands.shape[-1] < HAND:
            basis = person.hand_components[:, : hands.shape[-1]]
            hands = person.hand_mean + np.einsum("fhc,hcj->fhj", hands, basis)
        turn[:, 1 + (BODY + FACE) // 3 :] = np.asarray(hands, float).reshape(frames, -1, 3)
    local = rigid.rotation_from_vector(turn)
    bones = np.broadcast_to(np.eye(4), (frames, len(rest), 4, 4)).copy()
    for bone in range(1, len(rest)):
        above = person.parent[bone]
        offset = rest[bone, :3, 3] - rest[above, :3, 3]
        bones[:, bone] = bones[:, above] @ rigid.make(local[:, bone], np.broadcast_to(offset, (frames, 3)))
    pelvis = np.asarray(transl, float) + person.pelvis
    root = rigid.make(rigid.rotation_from_vector(np.asarray(global_orient, float)), pelvis)
    return BodyMotion(root, bones)
