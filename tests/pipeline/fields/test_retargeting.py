"""Retargeting of motion to the same body, to a larger one, and to one with other bones."""

import numpy as np

from pipeline.fields import retargeting
from pipeline.fields.skinning import SkinnedShape
from pipeline.geometry import rigid
from tests.stages.export_simulator import small_world

TRACK = small_world.trajectory(30, 0)
MOTION = TRACK.agent_from_bone.astype(float)


def body() -> SkinnedShape:
    mesh, weights = small_world.tube()
    return SkinnedShape(mesh.vertices.astype(float), weights, small_world.rest())


def posed(shape: SkinnedShape, bones: np.ndarray) -> np.ndarray:
    """Return vertex positions, [frame vertex 3]."""
    motion = bones @ rigid.inverse(shape.agent_from_bone_rest)
    return retargeting.transfer(motion, shape.weights, shape.vertices)[0]


def test_retargeting_to_the_same_body_is_the_identity() -> None:
    same = retargeting.retarget(body(), body(), TRACK.world_from_agent, MOTION)
    away = np.linalg.norm(posed(body(), same.agent_from_bone) - posed(body(), MOTION), axis=-1)
    assert away.max() < 1e-3 and same.residual_m.max() < 1e-3, "meters"
    np.testing.assert_allclose(same.world_from_agent, TRACK.world_from_agent)
    assert retargeting.shape_distance_m(body(), body()) < 1e-6


def test_motion_scales_with_the_body() -> None:
    small = body()
    rest = small.agent_from_bone_rest.copy()
    rest[:, :3, 3] *= 2
    big = SkinnedShape(2 * small.vertices, small.weights, rest)
    moved = retargeting.retarget(small, big, TRACK.world_from_agent, MOTION)
    away = np.linalg.norm(posed(big, moved.agent_from_bone) - 2 * posed(small, MOTION), axis=-1)
    assert away.max() < 2e-3, "meters"
    steps, own = (
        np.linalg.norm(np.diff(root[:, [0, 2], 3], axis=0), axis=1)
        for root in (TRACK.world_from_agent, moved.world_from_agent)
    )
    np.testing.assert_allclose(own, 2 * steps, rtol=1e-6)
    feet, own_feet = (
        root[:, 1, 3] + retargeting.extent(shape)[0, 1]
        for root, shape in ((TRACK.world_from_agent, small), (moved.world_from_agent, big))
    )
    np.testing.assert_allclose(own_feet, feet, atol=1e-9)  # meters: on the same floor


def test_other_bones_follow_the_same_surface() -> None:
    """Eight bones at other places along the same body deform it nearly like its own five."""
    own = body()
    place = np.linspace(-0.22, 0.22, 8)
    weights = np.exp(-((own.vertices[:, 2:] - place) ** 2) / (2 * 0.04**2))
    rest = rigid.make(np.eye(3), np.stack([0 * place, 0 * place, place], -1))
    other = SkinnedShape(own.vertices, weights / weights.sum(1, keepdims=True), rest)
    moved = retargeting.retarget(own, other, TRACK.world_from_agent, MOTION)
    assert moved.agent_from_bone.shape == (30, 8, 4, 4)
    np.testing.assert_allclose(np.linalg.det(moved.agent_from_bone[..., :3, :3]), 1, atol=1e-9)
    away = np.linalg.norm(posed(other, moved.agent_from_bone) - posed(own, MOTION), axis=-1)
    still = np.linalg.norm(own.vertices - posed(own, MOTION), axis=-1)
    assert away.mean() < 0.15 * still.mean()
