"""Encoding of companions: invariant to order, continuous at the range limit, and causal."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.behavior.config import PlanSamplingConfig, ReplanningConfig
from pipeline.behavior.diffusion import Schedule, guided
from pipeline.behavior.encoders import (
    ATTENDED_CHANNELS,
    HEADS,
    OtherPosesEncoder,
    OthersEncoder,
    with_anticipated,
)
from pipeline.behavior.model import BehaviorNets
from pipeline.behavior.planning import Sampler, TorchNetworks, observe
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.simulator import AnimalBatch
from pipeline.behavior.trajectories import (
    ABSENT_M,
    ANTICIPATED_SHARES,
    FUTURE,
    KINDS,
    MAX_COMPANIONS,
    PAST,
    BehaviorData,
    anticipated,
    anticipated_frames,
    as_companions,
    nearest,
)
from stages.train_behavior.objective import with_some_absent
from tests.pipeline.behavior.wandering import ARCHITECTURE, REST, room, scaling, wandering

ANIMAL = float(KINDS.index("animal"))


@pytest.fixture
def encoder():
    torch.manual_seed(0)
    net = OthersEncoder(8, 16, 8, 4.0, 10.0)
    for parameter in (net.animal, net.attention):
        torch.nn.init.normal_(parameter)
    return net.eval()


def companions_nearby(count, seed=0):
    """Companions within two meters of the agent, alternately animals and people."""
    drawn = torch.randn(2, count, 8, 10, generator=torch.Generator().manual_seed(seed)) * 0.5
    drawn[..., 9] = torch.arange(count)[:, None] % 2
    return drawn


def test_code_is_permutation_invariant_and_depends_on_each_companion(encoder):
    set_of_four, keep = companions_nearby(4), torch.ones(2)
    code = encoder(set_of_four, keep)
    torch.testing.assert_close(encoder(set_of_four[:, [2, 0, 3, 1]], keep), code)
    for gone in range(4):
        left = [number for number in range(4) if number != gone]
        assert (encoder(set_of_four[:, left], keep) - code).abs().max() > 1e-3


def test_positions_are_those_of_the_attended():
    net = OthersEncoder(8, 16, 8, 4.0, 10.0, positions=True).eval()
    one, keep = companions_nearby(1), torch.ones(2)
    code = net(one, keep)
    presence, x, z = code[:, 8:].unflatten(1, (HEADS, ATTENDED_CHANNELS)).unbind(-1)
    torch.testing.assert_close(presence, torch.ones(2, HEADS))
    torch.testing.assert_close(torch.stack([x, z], -1), one[:, :, -1, :3:2].expand(-1, HEADS, -1))
    absent = torch.zeros_like(one)
    absent[..., 0] = ABSENT_M
    torch.testing.assert_close(net(torch.cat([one, absent], 1), keep), code)
    for gone in (net(absent, keep), net(one, torch.zeros(2))):
        assert (gone[:, 8:] == 0).all()


def test_absent_companions_do_not_change_the_code(encoder):
    alone, keep = companions_nearby(1), torch.ones(2)
    absent = torch.zeros(2, 3, 8, 10)
    absent[..., 0], absent[:, 1:, :, 9] = ABSENT_M, ANIMAL
    torch.testing.assert_close(encoder(torch.cat([alone, absent], 1), keep), encoder(alone, keep))
    torch.testing.assert_close(encoder(absent, keep), encoder(alone, torch.zeros(2)))
    torch.testing.assert_close(encoder(companions_nearby(3), torch.zeros(2)), encoder(alone, torch.zeros(2)))


def test_departing_companions_fade_out(encoder):
    pair, keep = companions_nearby(2), torch.ones(2)
    pair[:, 1, :, :3] = torch.tensor([0.0, 0.0, 1.0])
    inside, outside = pair.clone(), pair.clone()
    inside[:, 1, :, 2], outside[:, 1, :, 2] = 3.999, 4.001
    assert (encoder(pair, keep) - encoder(outside, keep)).abs().max() > 1e-2
    torch.testing.assert_close(encoder(inside, keep), encoder(outside, keep), atol=2e-3, rtol=0)


def test_kind_of_companion_changes_the_code(encoder):
    person = companions_nearby(1)
    animal = person.clone()
    animal[..., 9] = ANIMAL
    assert (encoder(person, torch.ones(2)) - encoder(animal, torch.ones(2))).abs().max() > 1e-2


def test_nearest_companions_are_perceived():
    rng = np.random.default_rng(0)
    others = rng.uniform(-5, 5, (3, MAX_COMPANIONS + 5, PAST, 4))
    others[0] = np.nan
    others[1, 3, -1] = np.nan  # has left
    others[2, 4, :-1] = np.nan  # has just arrived
    others[2, 4, -1, :3] = 0.1
    agent = np.zeros((3, 3))
    some, order = nearest(others, agent)
    assert some.shape[1] == MAX_COMPANIONS and np.isfinite(some).all()
    assert (some[0, :, :, 0] == ABSENT_M).all()
    assert not (some[1] == others[1, 3, 0]).all(-1).any() and order[2, 0] == 4
    np.testing.assert_array_equal(some[2, 0], np.repeat(others[2, 4, -1:], PAST, 0))
    away = np.linalg.norm(some[2, :, -1][:, [0, 2]], axis=1)
    assert (np.diff(away) >= 0).all()


def test_observers_are_expected_to_go_on_until_they_are_nearest():
    back, here = np.arange(PAST - 1, -1, -1)[:, None], np.array([0.5, 1.4, 2.0])
    speed = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.1], [0.0, 0.0, 0.1], [0.0, 0.1, 0.0]])
    ahead = anticipated(here - back * speed[:, None], np.zeros((4, 3)), anticipated_frames(FUTURE))
    np.testing.assert_allclose(ahead[0], [here] * len(ANTICIPATED_SHARES))
    np.testing.assert_allclose(ahead[1, :, 2], [1.2, 0.4, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(ahead[2, :, 2], [2.8, 3.6, 4.8, 7.6])
    np.testing.assert_allclose(ahead[3], ahead[0], err_msg="a phone that is lifted")


def test_anticipation_matters_where_it_is_known_of_somebody_near(encoder):
    one, keep = companions_nearby(1), torch.ones(2)
    place = one[:, 0, -1:, :3].expand(-1, len(ANTICIPATED_SHARES), -1)
    code, coming = encoder(one, keep), encoder(with_anticipated(one, place * 0.5), keep)
    assert (coming - code).abs().max() > 1e-3
    assert (coming - encoder(with_anticipated(one, place), keep)).abs().max() > 1e-3
    torch.testing.assert_close(encoder(with_anticipated(one, place * 0 + ABSENT_M), keep), code)
    far = one + torch.eye(10)[0] * 6.0
    torch.testing.assert_close(encoder(with_anticipated(far, place), keep), encoder(far, keep))
    poses = OtherPosesEncoder(8, 16, 8).eval()
    torch.testing.assert_close(poses(with_anticipated(one, place), keep), poses(one, keep))


def with_companions(data: BehaviorData) -> BehaviorData:
    """Give each recording the animal of the next one as a companion, and a second one that is present at
    times.
    """
    tracks = list(data.trajectories.values())
    trajectories = {}
    for number, (name, track) in enumerate(data.trajectories.items()):
        place = tracks[(number + 1) % len(tracks)].world_from_agent[:, None, :3, 3].repeat(2, axis=1)
        kind = np.full((*place.shape[:2], 1), ANIMAL)
        being = np.concatenate([place, kind], axis=-1)
        being[::3, 1] = np.nan
        trajectories[name] = replace(track, companions=being.astype(np.float32))
    return replace(data, trajectories=trajectories)


def test_companions_survive_saving_and_are_in_the_ego_frame(tmp_path):
    data = with_companions(wandering())
    data.save(tmp_path)
    again = BehaviorData.load(tmp_path)
    context, _ = again.windows(np.array([3, 50, 90]))
    assert context.companions.shape == (3, 2, PAST, 4)
    seen = observe(context, room(), REST, "yaw").others
    between = context.companions[:, 0, -1, :3] - context.world_from_agent[:, -1, :3, 3]
    companion = (
        np.abs(np.linalg.norm(seen[:, 1:, -1, :3], axis=-1) - np.linalg.norm(between, axis=-1)[:, None])
        < 1e-5
    )
    assert companion.any(1).all() and (seen[:, 1:, :, 9] <= ANIMAL).all()


def test_companions_are_dropped_independently_but_not_an_oversampled_observer():
    others = companions_nearby(3).repeat(200, 1, 1, 1)
    left = with_some_absent(others, torch.ones(400, dtype=torch.bool), torch.Generator().manual_seed(0))
    absent = left[:, :, -1, 0] == ABSENT_M
    assert not absent[:, 0].any()
    assert absent[:, 1:].float().mean() == pytest.approx(0.1, abs=0.03)
    one = others[:, :1]
    assert with_some_absent(one, torch.zeros(400, dtype=torch.bool), torch.Generator()) is one


def test_guidance_scales_of_observer_and_companions_are_independent():
    denoisers = [lambda x, t, e=e: x + e for e in (7.0, 3.0, 1.0)]  # observer +4, companions +2, alone 1
    for observer, companions in ((1.0, 1.0), (0.5, 1.0), (1.0, 0.0), (0.3, 0.7), (0.0, 0.0)):
        expected = 1 + 2 * companions + 4 * observer
        assert guided(denoisers, (observer, companions))(0.0, 0) == pytest.approx(expected)


@pytest.fixture(scope="module")
def sampler():
    torch.manual_seed(0)
    nets = BehaviorNets(ARCHITECTURE)
    attentive = [parameter for member in nets.perception for parameter in member.others.parameters()]
    for parameter in (*attentive, *nets.goal.parameters()):
        torch.nn.init.normal_(parameter, std=0.3)
    return Sampler(TorchNetworks(nets), Schedule(), scaling())


def test_guidance_of_companions_changes_plans(sampler):
    context, _ = with_companions(wandering()).windows(np.array([3, 50]))
    seen = observe(context, room(), REST, "yaw")
    plain = PlanSamplingConfig(goal_steps=4, sequence_steps=2, avoid_solid=False)
    goals = [
        sampler.goals(sampler.codes(seen, how), np.random.default_rng(0))
        for how in (plain, replace(plain, companions_guidance=0.0), replace(plain, guidance=0.0))
    ]
    assert np.abs(goals[0] - goals[1]).max() > 1e-4
    assert np.abs(goals[0] - goals[2]).max() > 1e-4


def test_guidance_of_one_companion_changes_nothing_of_another(sampler):
    context, _ = with_companions(wandering()).windows(np.array([3, 50]))
    here = context.world_from_agent[:, :, :3, 3]
    beside = here[:, None] + np.array([[[0.4, 0.0, 0.3]], [[-0.9, 0.0, 0.2]]])
    context = replace(context, companions=as_companions(beside))
    plain = PlanSamplingConfig(goal_steps=4, sequence_steps=2, avoid_solid=False)

    def goals(scales, seen=context):
        codes = sampler.codes(observe(seen, room(), REST, "yaw"), replace(plain, companions_guidance=scales))
        return sampler.goals(codes, np.random.default_rng(0))

    np.testing.assert_allclose(goals((1.0, 1.0)), goals(1.0), atol=1e-6)
    assert np.abs(goals((1.0, 0.5)) - goals((0.5, 1.0))).max() > 1e-4
    for scales in ((1.0, 0.3), (0.3, 1.0)):
        swapped = replace(context, companions=context.companions[:, ::-1])
        np.testing.assert_allclose(goals(scales), goals(scales[::-1], swapped), atol=1e-4)
    alone = replace(context, companions=context.companions.copy())
    alone.companions[:, 1] = np.nan
    np.testing.assert_allclose(goals((0.3, 0.0), alone), goals((0.3, 1.0), alone), atol=1e-6)


def animals_in(scenes, sampler):
    sampling = PlanSamplingConfig(goal_steps=4, sequence_steps=2)
    return AnimalBatch(sampler, scenes, REST, "yaw", sampling=sampling, chaining=ReplanningConfig())


def test_simulated_animals_perceive_and_avoid_each_other(sampler):
    animals = animals_in(Scenes.of(room()), sampler)
    context, _ = wandering().windows(np.array([0, 40, 0, 40]))
    context = replace(context, video=None)
    far = np.full((4, 3), ABSENT_M)
    context = replace(context, observer_world=np.repeat(far[:, None], PAST, 1))
    plans = []
    for life in (None, np.array([0, 1, 2, 3]), np.array([0, 0, 1, 1])):
        animals.begin(context, np.random.default_rng(0), life)
        plans.append(animals.plan.root.copy())
    np.testing.assert_array_equal(plans[0], plans[1])
    assert np.abs(plans[0] - plans[2]).max() > 1e-3
    start = np.linalg.norm(context.world_from_agent[0, -1, :3, 3] - context.world_from_agent[1, -1, :3, 3])
    assert start > 0.4
    for _ in range(60):
        animals.step(far)
    assert animals.plans_drawn > 4


def test_external_companions_are_perceived_and_avoided(sampler):
    animals = animals_in(Scenes.of(room()), sampler)
    context, _ = wandering().windows(np.array([0]))
    context = replace(context, video=None, observer_world=np.full((1, PAST, 3), ABSENT_M))
    here, far = context.world_from_agent[:, -1, :3, 3], np.full((1, 3), ABSENT_M)

    def standing(place):
        return as_companions(np.repeat(place[:, None], PAST, 1))[None]

    plans = {}
    for name, beside in {"alone": None, "far": standing(far), "near": standing(here + 0.6)}.items():
        animals.begin(context, np.random.default_rng(0), companions=beside)
        plans[name] = animals.plan.root.copy()
    np.testing.assert_allclose(plans["alone"], plans["far"], atol=1e-4)
    assert np.abs(plans["alone"] - plans["near"]).max() > 5e-3, "meters"
    obstacle = here + np.array([[0.5, 0.0, 0.0]])
    animals.begin(context, np.random.default_rng(0), companions=standing(obstacle))
    lives = np.stack([animals.step(far, standing(obstacle)).root[0, 0, :3, 3] for _ in range(60)])
    assert np.linalg.norm((lives - obstacle)[:, [0, 2]], axis=-1).min() > animals.clearance_m - 1e-6
    drawn = []
    for moved_m in (0.0, 1.0):
        animals.begin(context, np.random.default_rng(0), companions=standing(obstacle))
        for _ in range(20):
            animals.step(far, standing(obstacle + np.array([moved_m, 0.0, 0.0])))
        drawn.append(animals.plans_drawn)
    assert drawn == [1, 2], "who has moved is planned for anew"


def beside_a_companion(sampler):
    """One animal and a companion at its goal in an empty room; the function moves the companion."""
    volume = room()
    scenes = Scenes((volume,), (np.ones_like(volume.occupancy, bool),), np.zeros(1, int))
    animals = animals_in(scenes, sampler)
    context, _ = wandering().windows(np.array([0]))
    context = replace(context, video=None, observer_world=np.full((1, PAST, 3), ABSENT_M))
    goal = context.world_from_agent[0, -1, :3, 3] + np.array([1.0, 0.0, 0.0])

    def at(offset):
        return as_companions(np.repeat((goal + offset)[None, None], PAST, 1))[None]

    animals.begin(context, np.random.default_rng(0), companions=at(0.0))
    animals.goal[0] = goal
    return animals, at


def test_intent_moves_with_the_companion_at_the_goal_and_ends_with_the_horizon(sampler):
    animals, at = beside_a_companion(sampler)
    first, far, moved = np.array([0]), np.full((1, 3), ABSENT_M), np.array([0.1, 0.0, 0.2])
    for _ in range(5):
        animals.step(far, at(moved))
    left = animals.plan_frames - 5
    intent, rest = animals._intent(first)[0], animals.plan.root[0, 5:, :3, 3]
    assert np.isnan(intent[left:]).all()
    np.testing.assert_allclose(intent[:left], rest + moved * (np.arange(left) / left)[:, None])
    volume = animals.scenes.volumes[0]
    wall = volume.origin[0] + volume.voxel_m * np.ceil(
        (rest[-1, 0] + 0.03 - volume.origin[0]) / volume.voxel_m
    )
    here = volume.origin[0] + volume.voxel_m * np.arange(volume.occupancy.shape[0]) < wall - 1e-6
    allowed = np.broadcast_to(here[:, None, None], volume.occupancy.shape)
    animals.scenes = Scenes((volume,), (allowed,), np.zeros(1, int))
    assert not animals.scenes.inside_solid(animals._intent(first)[:, :left], None).any(), "within the home"
    animals.goal[0] += 2.0
    np.testing.assert_allclose(animals._intent(first)[0, :left], rest)
    animals.observer[-1][0] += ABSENT_M
    assert np.isnan(animals._intent(first)).all(), "the observer has moved"
    animals.observer[-1][0] = ABSENT_M
    animals.command(np.ones((1, 3)))
    assert np.isnan(animals._intent(first)).all(), "commanded"
    animals.command(np.full((1, 3), np.nan))
    assert np.isnan(animals._intent(first)).all(), "released: where it was sent is no intent of its own"
    animals.intent_end[0] = animals.plan_frames
    animals.played[0] = animals.plan_frames - animals.chaining.blend_frames
    assert np.isnan(animals._intent(first)).all(), "its horizon has passed"
    animals.played[0], animals.companions = 5, None
    assert np.isnan(animals._intent(first)).all(), "alone"


def test_replanning_keeps_the_intent_until_the_horizon_of_the_first_plan(sampler):
    animals, at = beside_a_companion(sampler)
    far, ends = np.full((1, 3), ABSENT_M), []
    for frame in range(animals.plan_frames + 10):
        animals.step(far, at(np.array([0.05 * frame, 0.0, 0.0])))
        if animals.played[0] == 1:
            ends.append((frame, animals.intent_end[0]))
    horizon = animals.plan_frames
    kept = [frame + end for frame, end in ends if frame < horizon - animals.chaining.blend_frames]
    assert len(kept) > 2 and set(kept) == {horizon}
    assert ends[-1][0] + ends[-1][1] > horizon


def test_the_next_plan_has_the_goal_of_the_intent(sampler):
    animals, at = beside_a_companion(sampler)
    first, far = np.array([0]), np.full((1, 3), ABSENT_M)
    for _ in range(5):
        animals.step(far, at(np.array([0.1, 0.0, 0.2])))
    intent = animals._intent(first)[0, : animals.plan_frames - 5]
    plans = [animals._draw_plans(first, wanted)[1][0] for wanted in (intent[None], None)]
    np.testing.assert_allclose(plans[0], intent[-1], atol=1e-4)
    assert np.linalg.norm(plans[1] - intent[-1]) > 1e-2, "drawn anew without"


def test_candidate_nearest_to_the_intent_is_followed(sampler):
    animals, _ = beside_a_companion(sampler)
    context, _ = wandering().windows(np.array([0]))
    seen, frame = observe(context, animals.scenes, REST, "yaw"), np.eye(4)[None]
    none, free = np.full((1, 1, 3), np.nan), np.full((1, 3), np.nan)

    def drawn(intent):
        animals.rng = np.random.default_rng(1)
        return animals._least_blocked(codes, frame, None, free, intent)[1]

    codes, rng = sampler.codes(seen, animals.sampling, 8), np.random.default_rng(1)
    each = sampler.paths(codes, sampler.goals(codes, rng), rng)
    assert np.ptp(each[:, -1], axis=0).max() > 1e-2, "meters"
    np.testing.assert_array_equal(drawn(none)[0], each[0])
    for path in each:
        np.testing.assert_array_equal(drawn(path[None].astype(float))[0], path)
