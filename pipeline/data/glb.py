"""Write and read binary glTF 2.0: static meshes and skinned, animated ones.

A skinned file holds one root node that carries `world_from_agent`, every bone as a sibling joint under it
(bone b carries `agent_from_bone`), and beside the root the mesh, which follows its joints alone. Same
content, same bytes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import pygltflib as gltf
from jaxtyping import Float, Float32, UInt8

from pipeline.data import images
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh

T = TypeVar("T")

_FLOAT, _U8, _U32 = gltf.FLOAT, gltf.UNSIGNED_BYTE, gltf.UNSIGNED_INT
_ROOT_NODE, _MESH_NODE, _FIRST_JOINT = 0, 1, 2


@dataclass(frozen=True)
class Skin:
    """Four influences per vertex; `agent_from_bone_rest` is the bind pose."""

    joints: UInt8[np.ndarray, "vertex influence"]
    weights: Float32[np.ndarray, "vertex influence"]
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]
    bone_names: tuple[str, ...]


ROUNDING = 1e-4
"""Keys by which the end may lie before the last key: files hold times in single precision."""


@dataclass(frozen=True)
class Action:
    """One named animation: keyframes in seconds, root in the world, bones in the agent frame."""

    name: str
    time_s: Float[np.ndarray, " frame"]
    world_from_agent: Float[np.ndarray, "frame 4 4"]
    agent_from_bone: Float[np.ndarray, "frame bone 4 4"]

    def resampled(self, rate_hz: float) -> "Action":
        """Return it with even keys from time 0 on: rotations by slerp, translations linearly."""
        begin, end = self.time_s[[0, -1]]
        time_s = np.arange(int(np.floor((end - begin) * rate_hz + ROUNDING)) + 1) / rate_hz
        poses = self.world_from_agent, self.agent_from_bone
        query_s = np.minimum(begin + time_s, end)
        return Action(self.name, time_s, *rigid.interpolate_body(self.time_s, *poses, query_s))


def static(mesh: Mesh, name: str) -> bytes:
    """Return a file of a static mesh with vertex colors; meters, +y up."""
    document = _Document()
    document.add_mesh(mesh, name, None)
    document.file.nodes = [gltf.Node(name=name, mesh=0)]
    document.file.scenes = [gltf.Scene(nodes=[0])]
    return document.packed()


def skinned(mesh: Mesh, skin: Skin, actions: Sequence[Action]) -> bytes:
    """Return a file of a skinned mesh (agent frame, meters) with one animation per action."""
    document = _Document()
    document.add_mesh(mesh, "agent", skin)
    joints = list(range(_FIRST_JOINT, _FIRST_JOINT + len(skin.bone_names)))
    document.file.nodes = [
        gltf.Node(name="agent", children=joints),
        gltf.Node(name="agent_surface", mesh=0, skin=0),
    ]
    translations, quaternions = _translation_quaternion(skin.agent_from_bone_rest)
    for bone, translation, quaternion in zip(skin.bone_names, translations, quaternions, strict=True):
        place, turn = translation.tolist(), quaternion.tolist()
        document.file.nodes.append(gltf.Node(name=bone, translation=place, rotation=turn))
    inverse_bind = rigid.inverse(skin.agent_from_bone_rest).astype(np.float32)
    columns = np.ascontiguousarray(inverse_bind.transpose(0, 2, 1)).reshape(-1, 16)  # glTF is column-major
    matrices = document.add(columns, "MAT4", _FLOAT)
    bound = gltf.Skin(name="skin", joints=joints, skeleton=_ROOT_NODE, inverseBindMatrices=matrices)
    document.file.skins = [bound]
    document.file.animations = [document.animation(action) for action in actions]
    document.file.scenes = [gltf.Scene(nodes=[_ROOT_NODE, _MESH_NODE])]
    return document.packed()


class _Document:
    """A glTF document under construction and its binary buffer."""

    def __init__(self) -> None:
        self.file = gltf.GLTF2(asset=gltf.Asset(version="2.0", generator="agent-to-sim"), scene=0)
        self.blob = bytearray()

    def add(
        self, values: np.ndarray, kind: str, type: int, *, target: int | None = None, bounds: bool = False
    ) -> int:
        """Append an array and return its accessor."""
        values = np.ascontiguousarray(values)
        self.blob.extend(b"\0" * (-len(self.blob) % 4))
        start, number = len(self.blob), len(self.file.bufferViews)
        view = gltf.BufferView(buffer=0, byteOffset=start, byteLength=values.nbytes, target=target)
        self.file.bufferViews.append(view)
        self.blob.extend(values.tobytes())
        accessor = gltf.Accessor(bufferView=number, componentType=type, count=len(values), type=kind)
        if bounds:
            rows = values.reshape(len(values), -1)
            accessor.min, accessor.max = rows.min(0).tolist(), rows.max(0).tolist()
        self.file.accessors.append(accessor)
        return len(self.file.accessors) - 1

    def add_mesh(self, mesh: Mesh, name: str, skin: Skin | None) -> None:
        target = gltf.ARRAY_BUFFER
        attributes = gltf.Attributes(
            POSITION=self.add(mesh.vertices.astype(np.float32), "VEC3", _FLOAT, target=target, bounds=True),
            NORMAL=self.add(_unit_normals(mesh), "VEC3", _FLOAT, target=target),
        )
        if mesh.color is not None:
            linear = images.linear_from_srgb(mesh.color.astype(np.float32) / 255).astype(np.float32)
            rgba = np.pad(linear, ((0, 0), (0, 1)), constant_values=1)
            attributes.COLOR_0 = self.add(rgba, "VEC4", _FLOAT, target=target)
        if skin is not None:
            attributes.JOINTS_0 = self.add(skin.joints, "VEC4", _U8, target=target)
            attributes.WEIGHTS_0 = self.add(skin.weights, "VEC4", _FLOAT, target=target)
        corners = mesh.faces.astype(np.uint32).reshape(-1)
        indices = self.add(corners, "SCALAR", _U32, target=gltf.ELEMENT_ARRAY_BUFFER)
        matte = gltf.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=1.0)
        self.file.materials = [gltf.Material(name="surface", doubleSided=True, pbrMetallicRoughness=matte)]
        primitive = gltf.Primitive(attributes=attributes, indices=indices, material=0)
        self.file.meshes = [gltf.Mesh(name=name, primitives=[primitive])]

    def animation(self, action: Action) -> gltf.Animation:
        """Turn an action into channels: translation and rotation of the root and of every joint."""
        animation = gltf.Animation(name=action.name)
        keys = self.add(action.time_s.astype(np.float32), "SCALAR", _FLOAT, bounds=True)
        tracks = [(_ROOT_NODE, action.world_from_agent)]
        tracks += enumerate(np.swapaxes(action.agent_from_bone, 0, 1), start=_FIRST_JOINT)
        for node, parent_from_node in tracks:
            translation, quaternion = _translation_quaternion(parent_from_node)
            turns = _without_flips(quaternion)
            for path, values, kind in (("translation", translation, "VEC3"), ("rotation", turns, "VEC4")):
                output = self.add(values.astype(np.float32), kind, _FLOAT)
                sampler = gltf.AnimationSampler(input=keys, output=output, interpolation="LINEAR")
                target = gltf.AnimationChannelTarget(node=node, path=path)
                channel = gltf.AnimationChannel(sampler=len(animation.samplers), target=target)
                animation.samplers.append(sampler)
                animation.channels.append(channel)
        return animation

    def packed(self) -> bytes:
        """Return the whole file."""
        self.file.buffers = [gltf.Buffer(byteLength=len(self.blob))]
        self.file.set_binary_blob(bytes(self.blob))
        return b"".join(self.file.save_to_bytes())


def _translation_quaternion(parent_from_node: Float[np.ndarray, "n 4 4"]) -> tuple[np.ndarray, np.ndarray]:
    """Split rigid motions into translation and quaternion in glTF's order, xyzw."""
    wxyz = rigid.quaternion_from_rotation(np.asarray(parent_from_node[:, :3, :3], np.float64))
    return np.asarray(parent_from_node[:, :3, 3]), np.roll(wxyz, -1, axis=-1)


def _without_flips(quaternion: Float[np.ndarray, "frame 4"]) -> Float[np.ndarray, "frame 4"]:
    """Choose quaternion signs so that neighboring keyframes interpolate along the shorter arc."""
    flips = np.where((quaternion[1:] * quaternion[:-1]).sum(-1) < 0, -1.0, 1.0)
    return quaternion * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def _unit_normals(mesh: Mesh) -> Float32[np.ndarray, "vertex 3"]:
    """Vertex normals of unit length, +y where a vertex has no face: glTF forbids zero normals."""
    normals = mesh.vertex_normals().astype(np.float64)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length < 1e-6, [0.0, 1.0, 0.0], normals / np.maximum(length, 1e-6)).astype(np.float32)


def read_static(data: bytes) -> Mesh:
    """Read a file that `static` wrote."""
    return _Opened(data).mesh()


def read_skinned(data: bytes) -> tuple[Mesh, Skin, list[Action]]:
    """Read a file that `skinned` wrote: colors to 8 bits, everything else to float32."""
    document = _Opened(data)
    attributes = document.file.meshes[0].primitives[0].attributes
    table = document.file.skins[0]
    columns = document.values(table.inverseBindMatrices).reshape(-1, 4, 4)
    rest = rigid.inverse(columns.transpose(0, 2, 1).astype(np.float64))
    names = tuple(_given(document.file.nodes[joint].name) for joint in _given(table.joints))
    joints, weights = document.values(attributes.JOINTS_0), document.values(attributes.WEIGHTS_0)
    skin = Skin(joints, weights, rest, names)
    actions = [document.action(animation, len(names)) for animation in document.file.animations]
    return document.mesh(), skin, actions


def _given(value: T | None) -> T:
    """Narrow a value that pygltflib declares optional and `_Document` always writes."""
    assert value is not None, "not a file of this module"
    return value


class _Opened:
    """A glTF document opened for reading."""

    def __init__(self, data: bytes) -> None:
        self.file = _given(gltf.GLTF2.load_from_bytes(data))
        self.blob = _given(self.file.binary_blob())

    def values(self, index: int | None) -> np.ndarray:
        accessor = self.file.accessors[_given(index)]
        kind = {_FLOAT: "<f4", _U8: "u1", _U32: "<u4"}[accessor.componentType]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor.type]
        start = _given(self.file.bufferViews[_given(accessor.bufferView)].byteOffset)
        return np.frombuffer(self.blob, kind, accessor.count * width, start).reshape(accessor.count, -1)

    def mesh(self) -> Mesh:
        primitive = self.file.meshes[0].primitives[0]
        color = None
        if primitive.attributes.COLOR_0 is not None:
            linear = self.values(primitive.attributes.COLOR_0)[:, :3].astype(np.float64)
            color = np.rint(255 * images.srgb_from_linear(linear)).astype(np.uint8)
        faces = self.values(primitive.indices).reshape(-1, 3).astype(np.int32)
        return Mesh(self.values(primitive.attributes.POSITION).copy(), faces, color)

    def action(self, animation: gltf.Animation, bones: int) -> Action:
        """Read an animation, whose channels are in the order of `_Document.animation`."""
        outputs = [self.values(sampler.output) for sampler in animation.samplers]
        places, turns = np.stack(outputs[::2], 1), np.roll(np.stack(outputs[1::2], 1), 1, axis=-1)
        rotation = rigid.rotation_from_quaternion(turns.astype(np.float64))
        poses = rigid.make(rotation, places.astype(np.float64))
        assert poses.shape[1] == 1 + bones, poses.shape
        time_s = self.values(animation.samplers[0].input).ravel().astype(np.float64)
        return Action(_given(animation.name), time_s, poses[:, 0], poses[:, 1:])
