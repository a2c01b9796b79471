"""Animated glTF, read by another library: content round-trips and skinning equals linear blending."""

import io

import numpy as np
import pygltflib
import trimesh

from pipeline.data import glb
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh

RNG = np.random.default_rng(0)
BONES = 3


def skin_and_action() -> tuple[Mesh, glb.Skin, glb.Action]:
    """Random triangles on three bones with random motion."""
    vertices = RNG.normal(size=(12, 3)).astype(np.float32)
    faces = RNG.permuted(np.tile(np.arange(12), (8, 1)), axis=1)[:, :3].astype(np.int32)
    mesh = Mesh(vertices, faces, RNG.integers(0, 255, (12, 3), dtype=np.uint8))
    weights = np.concatenate([RNG.dirichlet(np.ones(BONES), 12), np.zeros((12, 1))], 1).astype(np.float32)
    joints = np.tile(np.array([0, 1, 2, 0], np.uint8), (12, 1))
    skin = glb.Skin(joints, weights, rigid.exp(RNG.normal(size=(BONES, 6))), ("tail", "back", "head"))
    frames = np.arange(5) / 30
    action = glb.Action(
        "walk", frames, rigid.exp(RNG.normal(size=(5, 6))), rigid.exp(RNG.normal(size=(5, BONES, 6)))
    )
    return mesh, skin, action


def accessor(file: pygltflib.GLTF2, index: int) -> np.ndarray:
    """Read the values of an accessor."""
    entry = file.accessors[index]
    view = file.bufferViews[entry.bufferView]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[entry.type]
    kind = {5126: np.float32, 5121: np.uint8, 5125: np.uint32}[entry.componentType]
    return np.frombuffer(file.binary_blob(), kind, entry.count * width, view.byteOffset).reshape(
        entry.count, width
    )


def test_joints_are_siblings_and_follow_the_action() -> None:
    mesh, skin, action = skin_and_action()
    file = pygltflib.GLTF2().load_from_bytes(glb.skinned(mesh, skin, [action]))
    root = file.nodes[file.scenes[0].nodes[0]]
    joints = file.skins[0].joints
    assert set(joints) <= set(root.children)
    assert not any(file.nodes[joint].children for joint in joints)
    bind = accessor(file, file.skins[0].inverseBindMatrices).reshape(BONES, 4, 4).transpose(0, 2, 1)
    np.testing.assert_allclose(bind @ skin.agent_from_bone_rest, np.tile(np.eye(4), (BONES, 1, 1)), atol=1e-5)
    moved = {}
    for channel in file.animations[0].channels:
        sampler = file.animations[0].samplers[channel.sampler]
        assert np.allclose(accessor(file, sampler.input)[:, 0], action.time_s)
        moved[channel.target.node, channel.target.path] = accessor(file, sampler.output)
    for bone, joint in enumerate(joints):
        rotation = rigid.rotation_from_quaternion(np.roll(moved[joint, "rotation"], 1, -1))
        np.testing.assert_allclose(rotation, action.agent_from_bone[:, bone, :3, :3], atol=1e-5)
        np.testing.assert_allclose(
            moved[joint, "translation"], action.agent_from_bone[:, bone, :3, 3], atol=1e-5
        )
        assert ((moved[joint, "rotation"][1:] * moved[joint, "rotation"][:-1]).sum(-1) >= 0).all(), (
            "the short way"
        )


def test_static_mesh_is_read_by_another_library() -> None:
    mesh, _, _ = skin_and_action()
    scene = trimesh.load(io.BytesIO(glb.static(mesh, "room")), file_type="glb", process=False)
    (found,) = scene.geometry.values()
    np.testing.assert_array_equal(found.vertices, mesh.vertices)
    np.testing.assert_array_equal(found.faces, mesh.faces)


def test_bytes_are_deterministic() -> None:
    mesh, skin, action = skin_and_action()
    assert glb.skinned(mesh, skin, [action]) == glb.skinned(mesh, skin, [action])
