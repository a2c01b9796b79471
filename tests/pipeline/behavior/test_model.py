from dataclasses import replace

import numpy as np
import pytest

from pipeline.baselines.predictors import Ats, ConstantVelocity, Corrected, LocationPrior, StandStill
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.model import BehaviorNets, Scaling, bones_from_channels, channels_from_bones
from pipeline.behavior.path_encoding import goal_error
from pipeline.behavior.planning import SampledPlan, Sampler, TorchNetworks, observe
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import TEST, TRAIN, BehaviorData
from pipeline.geometry import rigid
from tests.pipeline.behavior.wandering import ARCHITECTURE, REST, room, wandering


@pytest.fixture(scope="module")
def data():
    return wandering()


@pytest.fixture(scope="module")
def ats():
    channels = ARCHITECTURE.body_channels
    scaling = Scaling(
        np.array([1.0, 0.1, 1.0]),
        np.full((1, 4), 0.5),
        np.ones((3, 56)) * 0.5,
        np.zeros(channels),
        np.ones(channels) * 0.1,
    )
    sampler = Sampler(TorchNetworks(BehaviorNets(ARCHITECTURE)), Schedule(), scaling)
    return Ats(sampler, Scenes.of(room()), REST, "yaw", PlanSamplingConfig(goal_steps=4, sequence_steps=2))


def test_bone_encoding_is_inverted(data):
    bones = data.trajectories["v000"].agent_from_bone
    channels = channels_from_bones(bones, REST)
    assert channels.shape == (len(bones), 18)
    np.testing.assert_allclose(bones_from_channels(channels, REST), bones, atol=1e-6)
    np.testing.assert_allclose(channels_from_bones(REST, REST), 0, atol=1e-9)


def test_plan_is_transformed_to_the_world(data):
    _, future = data.windows(np.array([5]))
    frame = rigid.make(rigid.rotation_from_vector(np.array([[0, 0.4, 0]])), np.array([[1.0, 0, 2]]))
    ego = rigid.inverse(frame)[:, None] @ future.world_from_agent
    body = np.concatenate(
        [rigid.rotation_to_6d(ego[..., :3, :3]), channels_from_bones(future.agent_from_bone, REST)], axis=-1
    )
    plan = SampledPlan(ego[:, -1, :3, 3], ego[..., :3, 3], body)
    np.testing.assert_allclose(plan.world_from_agent(frame), future.world_from_agent, atol=1e-9)


def test_plans_are_deterministic_and_conditions_can_be_dropped(ats, data):
    context, _ = data.windows(np.array([0, 40]))
    observation = observe(context, room(), REST, "yaw")

    def plan(sampler=ats.sampler, **switches):
        return sampler.plan(
            observation,
            PlanSamplingConfig(goal_steps=4, sequence_steps=2, **switches),
            np.random.default_rng(1),
        )

    np.testing.assert_array_equal(plan().goal, plan().goal)
    ignoring = plan(guidance=0.0).goal
    np.testing.assert_allclose(ignoring, plan(observer=False).goal, atol=1e-6)
    nothing = plan(scene=False, observer=False, past=False, avoid_solid=False).goal
    of_all = replace(ats.sampler, guided="all")
    np.testing.assert_allclose(plan(of_all, guidance=0.0, avoid_solid=False).goal, nothing, atol=1e-6)
    full, half = plan(guidance=1.0).goal, plan(guidance=0.5).goal
    assert np.abs(full - ignoring).max() > np.abs(half - ignoring).max() > 0


def test_given_goal_and_path_are_kept(ats, data):
    context, _ = data.windows(np.array([0]))
    observation = observe(context, room(), REST, "yaw")
    goal, path = np.array([[0.3, 0.0, 0.7]]), np.linspace(0, 1, 56)[None, :, None] * [0.3, 0.0, 0.7]
    plan = ats.sampler.plan(observation, ats.sampling, np.random.default_rng(0), goal=goal, path=path)
    np.testing.assert_allclose(plan.goal, goal, atol=1e-6)
    np.testing.assert_allclose(plan.path, path, atol=1e-6)


def test_paths_that_miss_their_goals_are_resampled(ats, data):
    context, _ = data.windows(data.indices(TEST)[::20])
    sampling = replace(ats.sampling, avoid_solid=False)
    codes = ats.sampler.codes(observe(context, room(), REST, "yaw"), sampling, 8)
    goal = codes.start + np.random.default_rng(0).normal(0, 0.4, codes.start.shape)

    def misses(**changes):
        changed = replace(codes, sampling=replace(ats.sampling, **changes))
        path = ats.sampler.paths(changed, goal, np.random.default_rng(1))
        return goal_error(path, codes.start, goal)

    once, often = misses(max_path_draws=1), misses(max_path_draws=4)
    assert (once > 1).any() and (often < once)[once > 1].any(), (
        "networks that have learned nothing come nearer by luck"
    )
    assert (often <= once).all() and (often == once)[once <= 1].all()
    np.testing.assert_array_equal(
        misses(max_path_draws=4, guidance=0.5),
        misses(max_path_draws=1, guidance=0.5),
        "half a goal binds nobody",
    )
    np.testing.assert_array_equal(misses(max_path_draws=4, goal=False), misses(max_path_draws=1, goal=False))


def test_body_variance_scales_with_the_noise(ats, data):
    context, _ = data.windows(np.array([0]))
    codes = ats.sampler.codes(observe(context, room(), REST, "yaw"), ats.sampling, 40)
    path = np.tile(np.linspace(0, 1, 56)[None, :, None] * [0.3, 0.0, 0.7], (40, 1, 1))
    std = [
        ats.sampler.bodies(
            replace(codes, sampling=replace(ats.sampling, body_noise_std=noise_std)),
            path,
            np.random.default_rng(0),
        )
        .std(0)
        .mean()
        for noise_std in (0.0, 0.3, 1.0)
    ]
    assert std[0] < 1e-6 < std[1] < std[2]


def test_paths_without_noise_are_determined_by_the_goal(ats, data):
    context, _ = data.windows(np.array([0]))
    codes = ats.sampler.codes(observe(context, room(), REST, "yaw"), ats.sampling, 40)
    goal = np.tile([[0.3, 0.0, 0.7]], (40, 1))
    std = [
        ats.sampler.draw_paths(
            replace(codes, sampling=replace(ats.sampling, path_noise_std=noise_std)),
            goal,
            np.random.default_rng(0),
        )
        .std(0)
        .mean()
        for noise_std in (0.0, 1.0)
    ]
    assert std[0] < 1e-6 < 1e-3 < std[1]


def test_all_predictors_have_the_same_interface(ats, data):
    train = data.windows(data.indices(TRAIN))
    context, _ = data.windows(data.indices(TEST)[::20])
    for predictor in (ats, StandStill.fit(*train), ConstantVelocity.fit(*train), LocationPrior.fit(*train)):
        first, second = (predictor.sample(context, 16, np.random.default_rng(0)) for _ in range(2))
        assert first.goal.shape == (len(context), 16, 3)
        np.testing.assert_array_equal(first.goal, second.goal)
        if first.path is not None:
            assert first.path.shape == (len(context), 16, 56, 3)
            assert first.rotation.shape == (len(context), 16, 56, 3, 3)
            assert first.agent_from_bone.shape == (len(context), 16, 56, 3, 4, 4)
            np.testing.assert_allclose(np.linalg.det(first.rotation), 1, atol=1e-4)


def test_goals_equal_those_of_full_plans(ats, data):
    context, _ = data.windows(data.indices(TEST)[:3])
    whole, alone = (draw(context, 4, np.random.default_rng(0)).goal for draw in (ats.sample, ats.goals))
    np.testing.assert_allclose(alone, whole, atol=1e-6)


def test_standing_still_has_the_standard_deviation_of_training_goals(data):
    train = data.windows(data.indices(TRAIN))
    still = StandStill.fit(*train)
    moved = train[1].goal_world - train[0].world_from_agent[:, -1, :3, 3]
    assert still.std[-1, 0] == pytest.approx(np.sqrt((moved[:, [0, 2]] ** 2).mean()))
    drawn = (
        still.sample(train[0][:50], 400, np.random.default_rng(0)).goal
        - train[0].world_from_agent[:50, None, -1, :3, 3]
    )
    assert drawn[..., 0].std() == pytest.approx(still.std[-1, 0], rel=0.05)


def test_location_prior_samples_training_goals(data):
    context, future = data.windows(data.indices(TRAIN)[:40])
    prior = LocationPrior.fit(context, future)
    goals = prior.sample(context[:1], 500, np.random.default_rng(0)).goal[0]
    here = rigid.apply(rigid.inverse(context.world_from_agent[:, -1]), future.goal_world[:, None])[:, 0]
    there = rigid.apply(rigid.inverse(context.world_from_agent[:1, -1]), goals[None])[0]
    nearest = np.linalg.norm(there[:, None] - here, axis=-1).min(1)
    assert nearest.max() < 0.1 * np.sqrt(3) + 1e-6


def test_data_survive_saving(data, tmp_path):
    data.save(tmp_path)
    loaded = BehaviorData.load(tmp_path)
    assert loaded.videos == data.videos
    for before, after in zip(data.windows(np.arange(9)), loaded.windows(np.arange(9)), strict=True):
        for name, value in vars(before).items():
            np.testing.assert_array_equal(getattr(after, name), value)


def test_corrected_baselines_are_in_free_space_and_keep_what_was_free(data):
    train, (test, _) = data.windows(data.indices(TRAIN)), data.windows(data.indices(TEST)[::7])
    scenes = Scenes.of(room())
    for kind in (LocationPrior, ConstantVelocity):
        plain = kind.fit(*train)
        drawn, moved = (
            each.sample(test, 20, np.random.default_rng(0)) for each in (plain, Corrected(plain, scenes, 10))
        )
        for before, after in ((drawn.goal, moved.goal), (drawn.path, moved.path)):
            if before is None or after is None:
                continue
            solid = scenes.inside_solid(before, test.video)
            assert solid.mean() > 0.01
            assert not scenes.inside_solid(after, test.video).any()
            np.testing.assert_allclose(after[~solid][:, ::2], before[~solid][:, ::2], atol=1e-9)
