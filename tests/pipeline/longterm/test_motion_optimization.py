from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d

from pipeline.geometry import rigid
from pipeline.longterm.bodies import PosedSurface, PoseSpace
from pipeline.longterm.config import MotionOptimizationConfig
from pipeline.longterm.contacts import (
    SHORTEST_PHASE_FRAMES,
    SWING_M_S2,
    enforce_swing_time,
    find_contact_vertices,
)
from pipeline.longterm.motion_optimization import (
    contact_error,
    foot_error,
    lift_out_of_solid,
    optimize_motion,
    phase_means,
    settle_bodies,
    smooth_error,
)
from pipeline.longterm.plausibility import PlausibilityMeter, seams
from pipeline.longterm.short_motions import BodyMotion, smooth_seams
from tests.pipeline.longterm import strider

SETTINGS = MotionOptimizationConfig(steps=60, vertices=40)


@pytest.fixture(scope="module")
def dataset():
    return strider.dataset()


@pytest.fixture(scope="module")
def judge(dataset):
    contacts = find_contact_vertices(dataset.body, list(dataset.stretches), dataset.distances)
    return PlausibilityMeter(dataset.body, contacts, dataset.scenes[0].distance)


@pytest.fixture(scope="module")
def poses(dataset):
    return PoseSpace(dataset.body.agent_from_bone_rest, 16).fit(
        np.concatenate([s.agent_from_bone for s in dataset.stretches])
    )


def test_soles_are_found_and_form_four_feet(dataset, judge):
    soles = np.flatnonzero(dataset.body.mesh.vertices[:, 1] < -0.199)
    assert judge.contacts.vertices.tolist() == soles.tolist()
    assert judge.contacts.feet == 4
    bone = dataset.body.weights[judge.contacts.vertices].argmax(1)
    assert all(len(set(bone[judge.contacts.foot == foot])) == 1 for foot in range(4))


def test_stance_ratio_and_residuals_of_the_true_motion(dataset, judge, poses):
    moving = dataset.stretches[0]
    stance = judge.stance(moving)
    assert stance.mean(0) == pytest.approx([0.67] * 4, abs=0.12)
    worth = judge.plausibility(moving, stance)
    assert worth.slide_m_s < 0.01
    assert worth.contact == 1
    assert worth.non_collision > 0.999


def test_stances_leave_time_for_swings():
    """One foot glides at the speed of the body, one rests, one jumps 10 cm sideways between two rests."""
    feet = np.zeros((120, 3, 3))
    feet[:, 0, 2] = np.arange(120) / 30
    feet[60:, 2, 0] = 0.1
    stance = np.ones((120, 3), bool)
    stance[60, 2] = False
    kept = enforce_swing_time(stance, feet)
    assert kept[:, 1].all()
    gaps = {foot: np.diff(np.flatnonzero(np.diff(kept[:, foot].astype(int))))[::2] for foot in (0, 2)}
    assert gaps[2].tolist() == [int(np.ceil(np.sqrt(6 * 0.1 / SWING_M_S2) * 30))]
    assert len(gaps[0]) >= 3 and kept[:, 0].sum() > 3 * SHORTEST_PHASE_FRAMES
    away = np.diff(
        [
            feet[phase, 0, 2].mean()
            for phase in np.split(np.arange(120), np.flatnonzero(np.diff(kept[:, 0].astype(int))) + 1)[::2]
        ]
    )
    assert (gaps[0] + 2 >= np.sqrt(6 * away / SWING_M_S2) * 30).all()


def test_noisy_motion_becomes_physical_and_stays_close(dataset, judge, poses):
    truth = dataset.stretches[0][:120]
    shake = gaussian_filter1d(np.random.default_rng(1).normal(size=(120, 3)), 4, axis=0) * [0.05, 0.05, 0.05]
    root = truth.world_from_agent.copy()
    root[:, :3, 3] += shake
    shaken = BodyMotion(root, truth.agent_from_bone)
    stance = judge.stance(truth)
    done = optimize_motion(shaken, judge, poses, SETTINGS)
    before, after = judge.plausibility(shaken, stance), judge.plausibility(done, stance)
    assert after.penetration_m < 0.2 * before.penetration_m
    assert after.slide_m_s < 0.5 * before.slide_m_s
    surface = PosedSurface(dataset.body)
    error = [
        float((surface(*m.tensors()) - surface(*truth.tensors())).norm(dim=-1).mean()) for m in (shaken, done)
    ]
    assert error[1] < 1.1 * error[0]


def test_gliding_motion_gets_stances(dataset, judge, poses):
    walk = dataset.stretches[0][:90]
    mean = np.repeat(walk.agent_from_bone.mean(0, keepdims=True), len(walk), axis=0)
    mean[..., :3, :3] = walk.agent_from_bone[0, :, :3, :3]
    gliding = BodyMotion(walk.world_from_agent, 0.85 * mean + 0.15 * walk.agent_from_bone)
    done = optimize_motion(gliding, judge, poses, SETTINGS)
    before, after = (judge.plausibility(each, judge.stance(each)).min_slide_m_s for each in (gliding, done))
    assert before > 0.1 and after < 0.3 * before
    assert not judge.stance(gliding).any() and judge.stance(done).any(axis=1).mean() > 0.5


def test_fixed_frames_are_unchanged(dataset, judge, poses):
    moving, held = dataset.stretches[1][:30], np.arange(30) % 29 == 0
    lifted = BodyMotion(moving.world_from_agent + np.eye(4)[:, 3] * 0 + _lift(0.03), moving.agent_from_bone)
    done = optimize_motion(lifted, judge, poses, replace(SETTINGS, steps=10), held=held)
    np.testing.assert_allclose(done.world_from_agent[held], lifted.world_from_agent[held], atol=1e-6)
    assert np.abs(done.world_from_agent[~held] - lifted.world_from_agent[~held]).max() > 1e-3


def test_penetrating_motion_is_moved_out_of_the_block(dataset, judge, poses):
    walk = strider.striding(np.array([[0.36, 0, -0.2], [0.36, 0, 0.2]]), 1.0)
    stance = judge.stance(walk)
    assert judge.plausibility(walk, stance).deepest_m > 0.05
    done = optimize_motion(walk, judge, poses, replace(SETTINGS, steps=150))
    assert judge.plausibility(done, stance).deepest_m < 0.02


def test_unsampled_vertices_are_moved_out_of_a_board(dataset, judge, poses):
    """Only one vertex of the trunk, on the far side, is sampled for collisions."""
    board = strider.merged(strider.room(), strider.box([0.85, 0.17, -1], [1.3, 0.6, 1]))
    scene = replace(dataset.scenes[0], mesh=board).distance
    walk = strider.striding(np.array([[0.82, 0, -0.3], [0.82, 0, 0.3]]), 1.0)
    deepest = [
        float(-scene.at(PosedSurface(dataset.body)(*each.tensors())).min())
        for each in (
            walk,
            optimize_motion(
                walk, replace(judge, scene=scene), poses, replace(SETTINGS, steps=100, vertices=1)
            ),
        )
    ]
    assert deepest[0] > 0.03 and deepest[1] < 0.005


def test_terms_have_known_values():
    stance = np.array([[1, 0], [1, 1], [0, 1], [1, 1]], bool)
    flat, phase = phase_means(stance)
    assert flat.tolist() == [0, 2, 3, 5, 6, 7]
    assert phase.tolist() == [0, 0, 2, 2, 1, 2]
    feet = torch.zeros(4, 2, 3)
    feet[1, 0, 0] = 0.2
    torch.testing.assert_close(foot_error(feet, (flat, phase), 1e-6), torch.tensor([0.1, 0.1, 0, 0, 0, 0]))
    assert foot_error(feet, phase_means(np.zeros((4, 2), bool)), 0.002).shape == (0,)
    torch.testing.assert_close(
        contact_error(torch.tensor([0.0, 0.02, 100.0]), 0.02), torch.tensor([0.0, 0.5, 1.0])
    )
    even = torch.arange(5.0)[:, None, None].expand(5, 1, 3)
    assert smooth_error(even).sum() == 0
    assert smooth_error(even**2).sum() == 3 * 3 * 2**2


def test_discontinuity_at_a_seam_is_measured(dataset):
    moving = dataset.stretches[0]
    assert seams(dataset.body, moving, 60).max() < 0.02
    root = moving.world_from_agent.copy()
    root[60:, 0, 3] += 0.1
    torn = BodyMotion(root, moving.agent_from_bone)
    assert seams(dataset.body, torn, 60).max() > 0.08
    whole = smooth_seams(torn)
    assert seams(dataset.body, whole, 60).max() < 0.02
    away = np.abs(np.arange(len(torn)) - 60)
    far = (away > 6) & (np.arange(len(torn)) < 110)
    np.testing.assert_allclose(whole.world_from_agent[far], torn.world_from_agent[far], atol=1e-9)
    np.testing.assert_allclose(whole.world_from_agent[60], torn.world_from_agent[60], atol=1e-9)


def _lift(height_m):
    return (
        rigid.make(np.zeros((3, 3)), np.array([0.0, height_m, 0.0]))
        * (np.arange(4) == 3)[None]
        * (np.arange(4) < 3)[:, None]
    )


def test_feet_are_lifted_out_of_boards_but_not_out_of_walls(dataset):
    scene = dataset.scenes[0].distance  # a floor at 0, a block up to 0.5, walls at 2
    depth = np.repeat([0.0, 0.06], 40)
    floor = torch.tensor(
        np.stack([np.full(80, 1.2), 0.005 - depth, np.full(80, 1.2)], axis=-1)[:, None]
    ).float()
    raised = lift_out_of_solid(floor, scene, reach=4).numpy()
    assert (
        raised[0] == 0
        and raised[-1] == pytest.approx(0.06, abs=0.025)
        and np.abs(np.diff(raised)).max() < 0.02
    )
    assert lift_out_of_solid(torch.tensor([[[0.0, 0.1, 0.0]]]), scene, reach=0) == 0, (
        "0.4 m under the top of the block"
    )


def test_single_bodies_are_moved_onto_the_floor(dataset, judge, poses):
    still = dataset.stretches[0][np.array([0, 40, 80])]
    root = still.world_from_agent.copy()
    root[:, 1, 3] += [-0.06, 0.0, 0.03]
    done = settle_bodies(BodyMotion(root, still.agent_from_bone), judge, poses)
    gap, depth = judge.gap_and_penetration(done)
    assert gap.max() < 0.006 and depth.max() < 0.006
    assert len(settle_bodies(done[:1], judge, poses)) == 1
