"""A skinned, animated tube as glTF, with its vertices at one time, for tests of other programs."""

import numpy as np
from jaxtyping import Float

from pipeline.data import glb
from pipeline.data.glb import Action, Skin
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from tests.stages.export_simulator import small_world

SECONDS = 1.2
"""A key frame of the animation."""


def skinned_tube() -> tuple[Mesh, Skin]:
    """Return a tube of five bones with four influences per vertex."""
    mesh, weights = small_world.tube()
    joints = np.argsort(-weights, 1)[:, :4]
    kept = np.take_along_axis(weights, joints, 1)
    kept = (kept / kept.sum(1, keepdims=True)).astype(np.float32)
    names = tuple(f"bone_{bone:02d}" for bone in range(small_world.BONES))
    return mesh, Skin(joints.astype(np.uint8), kept, small_world.rest(), names)


def model() -> tuple[bytes, Float[np.ndarray, "corner 3"]]:
    """Return the file with the action `walk`, and its vertices in the world at `SECONDS`, meters."""
    mesh, skin = skinned_tube()
    track = small_world.trajectory(20, 0)
    motion = track.agent_from_bone.astype(np.float64)
    frame = int(np.argmin(np.abs(track.timestamp_s - SECONDS)))
    agent_from_agent = motion[frame] @ rigid.inverse(small_world.rest())
    corners = np.einsum("vk,vkij->vij", skin.weights, agent_from_agent[skin.joints])
    at = np.einsum("vij,vj->vi", corners[:, :3, :3], mesh.vertices) + corners[:, :3, 3]
    actions = [Action("walk", track.timestamp_s, track.world_from_agent, motion)]
    return glb.skinned(mesh, skin, actions), rigid.apply(track.world_from_agent[frame], at)
