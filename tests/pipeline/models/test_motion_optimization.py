from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d

from pipeline.models.bodies import PosedSurface, PoseSpace
from pipeline.models.contacts import BRIEFEST, SWING_M_S2, find_contacts, tensors, with_time_to_swing
from pipeline.models.motion_optimization import (
    Physique,
    Settings,
    contact_error,
    foot_error,
    lift,
    optimise,
    phase_means,
    settled,
    smooth_error,
)
from pipeline.models.plausibility import Judge, seams
from pipeline.models.short_motions import Moving, eased
from pipeline.space import rigid
from tests.pipeline.models import strider

SETTINGS = Settings(steps=60, vertices=40)


@pytest.fixture(scope="module")
def lives():
    return strider.lives()


@pytest.fixture(scope="module")
def physique(lives):
    contacts = find_contacts(lives.body, list(lives.stretches), lives.distances)
    poses = PoseSpace(lives.body.agent_from_bone_rest, 16).fit(np.concatenate([s.agent_from_bone for s in lives.stretches]))
    return Physique(lives.body, contacts, poses)


def test_soles_are_found_and_form_four_feet(lives, physique):
    soles = np.flatnonzero(lives.body.mesh.vertices[:, 1] < -0.199)
    assert physique.contacts.vertices.tolist() == soles.tolist()
    assert physique.contacts.feet == 4
    bone = lives.body.weights[physique.contacts.vertices].argmax(1)
    assert all(len(set(bone[physique.contacts.foot == foot])) == 1 for foot in range(4))


def test_feet_stand_two_thirds_of_the_time_and_true_motion_is_physical(lives, physique):
    judge, moving = Judge(lives.body, physique.contacts, lives.scenes[0].distance), lives.stretches[0]
    stance = judge.stance(moving)
    assert stance.mean(0) == pytest.approx([0.67] * 4, abs=0.12)
    worth = judge.plausibility(moving, stance)
    assert worth.slide_m_s < 0.01
    assert worth.contact == 1
    assert worth.non_collision > 0.999


def test_feet_that_should_stand_have_time_to_swing():
    """One foot glides at the body's pace, one rests, one leaps 10 cm aside between two rests."""
    feet = np.zeros((120, 3, 3))
    feet[:, 0, 2] = np.arange(120) / 30
    feet[60:, 2, 0] = 0.1
    stance = np.ones((120, 3), bool)
    stance[60, 2] = False
    kept = with_time_to_swing(stance, feet, 30.0)
    assert kept[:, 1].all()
    gaps = {foot: np.diff(np.flatnonzero(np.diff(kept[:, foot].astype(int))))[::2] for foot in (0, 2)}
    assert gaps[2].tolist() == [int(np.ceil(np.sqrt(6 * 0.1 / SWING_M_S2) * 30))]
    assert len(gaps[0]) >= 3 and kept[:, 0].sum() > 3 * BRIEFEST
    away = np.diff(
        [feet[phase, 0, 2].mean() for phase in np.split(np.arange(120), np.flatnonzero(np.diff(kept[:, 0].astype(int))) + 1)[::2]]
    )
    assert (gaps[0] + 2 >= np.sqrt(6 * away / SWING_M_S2) * 30).all()


def test_a_shaken_motion_becomes_physical_and_stays_near(lives, physique):
    truth = lives.stretches[0][:120]
    shake = gaussian_filter1d(np.random.default_rng(1).normal(size=(120, 3)), 4, axis=0) * [0.05, 0.05, 0.05]
    root = truth.world_from_agent.copy()
    root[:, :3, 3] += shake
    shaken = Moving(root, truth.agent_from_bone)
    scene = lives.scenes[0].distance
    judge = Judge(lives.body, physique.contacts, scene)
    stance = judge.stance(truth)
    done = optimise(shaken, physique, scene, SETTINGS)
    before, after = judge.plausibility(shaken, stance), judge.plausibility(done, stance)
    assert after.penetration_m < 0.2 * before.penetration_m
    assert after.slide_m_s < 0.5 * before.slide_m_s
    surface = PosedSurface(lives.body)
    error = [float((surface(*tensors(m)) - surface(*tensors(truth))).norm(dim=-1).mean()) for m in (shaken, done)]
    assert error[1] < 1.1 * error[0]


def test_a_gliding_motion_gets_feet_that_stand(lives, physique):
    walk = lives.stretches[0][:90]
    mean = np.repeat(walk.agent_from_bone.mean(0, keepdims=True), len(walk), axis=0)
    mean[..., :3, :3] = walk.agent_from_bone[0, :, :3, :3]
    gliding = Moving(walk.world_from_agent, 0.85 * mean + 0.15 * walk.agent_from_bone)
    scene = lives.scenes[0].distance
    judge = Judge(lives.body, physique.contacts, scene)
    done = optimise(gliding, physique, scene, SETTINGS)
    before, after = (judge.plausibility(each, judge.stance(each)).least_slide_m_s for each in (gliding, done))
    assert before > 0.1 and after < 0.3 * before
    assert not judge.stance(gliding).any() and judge.stance(done).any(axis=1).mean() > 0.5


def test_held_frames_stay(lives, physique):
    moving, held = lives.stretches[1][:30], np.arange(30) % 29 == 0
    lifted = Moving(moving.world_from_agent + np.eye(4)[:, 3] * 0 + _lift(0.03), moving.agent_from_bone)
    done = optimise(lifted, physique, lives.scenes[0].distance, replace(SETTINGS, steps=10), held=held)
    np.testing.assert_allclose(done.world_from_agent[held], lifted.world_from_agent[held], atol=1e-6)
    assert np.abs(done.world_from_agent[~held] - lifted.world_from_agent[~held]).max() > 1e-3


def test_a_motion_pushed_into_the_block_comes_out(lives, physique):
    walk = strider.striding(np.array([[0.36, 0, -0.2], [0.36, 0, 0.2]]), 1.0)
    scene = lives.scenes[0].distance
    judge = Judge(lives.body, physique.contacts, scene)
    stance = judge.stance(walk)
    assert judge.plausibility(walk, stance).deepest_m > 0.05
    done = optimise(walk, physique, scene, replace(SETTINGS, steps=150))
    assert judge.plausibility(done, stance).deepest_m < 0.02


def test_what_nobody_looks_at_comes_out_of_a_board_too(lives, physique):
    """Of the trunk one vertex is looked at, on the far side."""
    board = strider.merged(strider.room(), strider.box([0.85, 0.17, -1], [1.3, 0.6, 1]))
    scene = replace(lives.scenes[0], mesh=board).distance
    walk = strider.striding(np.array([[0.82, 0, -0.3], [0.82, 0, 0.3]]), 1.0)
    deepest = [
        float(-scene.at(PosedSurface(lives.body)(*tensors(each))).min())
        for each in (walk, optimise(walk, physique, scene, replace(SETTINGS, steps=100, vertices=1)))
    ]
    assert deepest[0] > 0.03 and deepest[1] < 0.005


def test_terms_are_what_they_say():
    stance = np.array([[1, 0], [1, 1], [0, 1], [1, 1]], bool)
    flat, phase = phase_means(stance)
    assert flat.tolist() == [0, 2, 3, 5, 6, 7]
    assert phase.tolist() == [0, 0, 2, 2, 1, 2]
    feet = torch.zeros(4, 2, 3)
    feet[1, 0, 0] = 0.2
    torch.testing.assert_close(foot_error(feet, (flat, phase), 1e-6), torch.tensor([0.1, 0.1, 0, 0, 0, 0]))
    assert foot_error(feet, phase_means(np.zeros((4, 2), bool)), 0.002).shape == (0,)
    torch.testing.assert_close(contact_error(torch.tensor([0.0, 0.02, 100.0]), 0.02), torch.tensor([0.0, 0.5, 1.0]))
    even = torch.arange(5.0)[:, None, None].expand(5, 1, 3)
    assert smooth_error(even, "acceleration").sum() == 0
    assert smooth_error(even, "velocity").sum() == 4 * 3


def test_a_jump_at_a_seam_is_measured(lives):
    moving = lives.stretches[0]
    assert seams(lives.body, moving, 60).max() < 0.02
    root = moving.world_from_agent.copy()
    root[60:, 0, 3] += 0.1
    torn = Moving(root, moving.agent_from_bone)
    assert seams(lives.body, torn, 60).max() > 0.08
    whole = eased(torn)
    assert seams(lives.body, whole, 60).max() < 0.02
    away = np.abs(np.arange(len(torn)) - 60)
    far = (away > 6) & (np.arange(len(torn)) < 110)
    np.testing.assert_allclose(whole.world_from_agent[far], torn.world_from_agent[far], atol=1e-9)
    np.testing.assert_allclose(whole.world_from_agent[60], torn.world_from_agent[60], atol=1e-9)


def _lift(height_m):
    return rigid.make(np.zeros((3, 3)), np.array([0.0, height_m, 0.0])) * (np.arange(4) == 3)[None] * (np.arange(4) < 3)[:, None]


def test_feet_in_a_board_are_lifted_out_of_it_and_those_in_a_wall_are_not(lives):
    scene = lives.scenes[0].distance  # a floor at 0, a block up to 0.5, walls at 2
    depth = np.repeat([0.0, 0.06], 40)
    floor = torch.tensor(np.stack([np.full(80, 1.2), 0.005 - depth, np.full(80, 1.2)], axis=-1)[:, None]).float()
    raised = lift(floor, scene, reach=4).numpy()
    assert raised[0] == 0 and raised[-1] == pytest.approx(0.06, abs=0.025) and np.abs(np.diff(raised)).max() < 0.02
    assert lift(torch.tensor([[[0.0, 0.1, 0.0]]]), scene, reach=0) == 0, "0.4 m under the top of the block"


def test_single_bodies_come_out_of_the_floor_and_down_from_the_air(lives, physique):
    still = lives.stretches[0][np.array([0, 40, 80])]
    judge = Judge(lives.body, physique.contacts, lives.scenes[0].distance)
    root = still.world_from_agent.copy()
    root[:, 1, 3] += [-0.06, 0.0, 0.03]
    done = settled(Moving(root, still.agent_from_bone), physique, judge.scene, SETTINGS)
    gap, depth = judge.fit_of(done)
    assert gap.max() < 0.006 and depth.max() < 0.006
    assert len(settled(done[:1], physique, judge.scene, replace(SETTINGS, steps=2))) == 1
