"""The synthetic animal: one closed surface, exact inverse kinematics, no foot skate."""

import numpy as np

from pipeline.geometry import rigid
from stages.synthesize_capture import animal, gait, room
from stages.synthesize_capture.session import simulate_session
from tests.stages.synthesize_capture.walks import straight

CREATURE = animal.grow(np.random.default_rng(0), cell_m=0.02)
FEET = [animal.INDEX[name] for name in gait.FEET]


def test_rest_pose_gives_the_rest_surface():
    rest = rigid.make(np.eye(3), animal.HEADS)
    np.testing.assert_allclose(animal.surface(CREATURE, rest), CREATURE.vertices, atol=1e-6)
    np.testing.assert_allclose(CREATURE.weight.sum(1), 1, atol=1e-5)


def test_feet_in_stance_do_not_slide():
    for speed in (0.6, 1.2, 2.0):
        course = straight(speed)
        times = np.linspace(1.0, 3.0, 400)
        feet = _feet(gait.poses(course, times))
        low = feet[..., 1] < animal.CAT.gait.sole_m + 0.0005
        drift = np.linalg.norm(np.diff(feet[..., [0, 2]], axis=0), axis=-1) / np.diff(times)[:, None]
        planted = low[1:] & low[:-1]
        assert planted.mean() > 0.3, "each foot carries weight for a good part of the stride"
        assert np.quantile(drift[planted], 0.9) < 0.05, f"m/s at {speed} m/s"
        assert (low.sum(1) >= 1).mean() > 0.6


def test_bones_are_rigid_and_legs_keep_their_length():
    motion = gait.poses(straight(0.8, posture=(0.5, 0.0, 0.0)), np.linspace(0.5, 3.0, 60))
    rotation = motion.agent_from_bone[..., :3, :3]
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, -1, -2), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-6
    )
    for upper, lower in (("left upper arm", "left forearm"), ("right thigh", "right shank")):
        gap = (
            motion.agent_from_bone[:, animal.INDEX[upper], :3, 3]
            - motion.agent_from_bone[:, animal.INDEX[lower], :3, 3]
        )
        np.testing.assert_allclose(
            np.linalg.norm(gap, axis=-1),
            np.linalg.norm(animal.HEADS[animal.INDEX[upper]] - animal.HEADS[animal.INDEX[lower]]),
            atol=2e-3,
        )


def test_legs_reach_their_paws_after_jumps():
    home = room.furnish(np.random.default_rng(0))
    rng = np.random.default_rng(0)
    course = simulate_session(home.arranged(rng), rng, 60.0).animal
    assert course.airborne.any()
    motion = gait.poses(course, np.arange(0, 60, 0.1))
    for upper, lower, paw in (
        ("left upper arm", "left forearm", "left hand"),
        ("right thigh", "right shank", "right foot"),
    ):
        first, second, last = (
            motion.agent_from_bone[:, animal.INDEX[name], :3, 3] for name in (upper, lower, paw)
        )
        length = np.linalg.norm(second - first, axis=-1).max() + 1e-3
        assert (np.linalg.norm(last - second, axis=-1) < length + 0.02).all(), "meters"


def test_normals_point_outwards():
    normals = animal.normals_of(CREATURE.vertices.astype(float), CREATURE.faces)
    top = CREATURE.vertices[:, 1] > 0.06
    belly = (np.abs(CREATURE.vertices[:, 2]) < 0.05) & (CREATURE.vertices[:, 1] < -0.06)
    assert normals[top & (np.abs(CREATURE.vertices[:, 2]) < 0.05), 1].mean() > 0.5
    assert normals[belly, 1].mean() < -0.5


def _feet(motion: gait.AnimalMotion) -> np.ndarray:
    return rigid.apply(motion.world_from_agent, motion.agent_from_bone[:, FEET][..., :3, 3])
