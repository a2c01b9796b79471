"""Scores of a trial: an oracle has no error, and every method runs through its protocols in its own scenes."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.baselines import samplers
from pipeline.baselines.predictors import Ats
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.diffusion import STANDARD
from pipeline.behavior.model import BehaviorNets, Scaling, channels_from_bones
from pipeline.behavior.path_encoding import PATH_CHANNELS
from pipeline.behavior.perception import world_from_ego
from pipeline.behavior.planning import Observation, Sampler, TorchNetworks
from pipeline.behavior.scenes import Scenes
from pipeline.geometry import rigid
from stages.score_behavior import approaches, protocols
from stages.score_behavior.approaches import RecordedApproaches
from stages.score_behavior.config import Config
from tests.pipeline.behavior.wandering import ARCHITECTURE, REST, room, wandering

EFFORT = Config(samples=4, trials=2, stride=20, plan_stride=30)
QUICK = PlanSamplingConfig(goal_steps=2, sequence_steps=2)


def untrained(architecture):
    channels = architecture.body_channels
    scaling = Scaling(
        np.ones(3), np.ones(4), np.ones((3, architecture.future)), np.zeros(channels), np.ones(channels)
    )
    sampler = samplers.sampler_of(architecture, TorchNetworks(BehaviorNets(architecture)), STANDARD, scaling)
    return Ats(sampler, Scenes.of(room()), REST, architecture.ego, QUICK)


class Oracle:
    """A sampler that knows the future."""

    def __init__(self, architecture, data, index):
        context, future = data.windows(index)
        ego = rigid.inverse(world_from_ego(context.world_from_agent[:, -1], architecture.ego))
        root = ego[:, None] @ future.world_from_agent
        bones = channels_from_bones(future.agent_from_bone, REST)
        self.path, self.body = (
            root[..., :3, 3],
            np.concatenate([rigid.rotation_to_6d(root[..., :3, :3]), bones], -1),
        )

    def codes(self, observation, sampling, count=1):
        return count

    def paths(self, count, goal, rng):
        np.testing.assert_allclose(goal, np.repeat(self.path[:, -1], count, 0), atol=1e-9)
        return np.repeat(self.path, count, axis=0)

    def bodies(self, count, path, rng):
        np.testing.assert_allclose(path, np.repeat(self.path, count, 0), atol=1e-9)
        return np.repeat(self.body, count, axis=0)


def test_oracle_has_no_error():
    data, index = wandering(), np.array([0, 30, 100])
    context, future = data.windows(index)
    ats = replace(untrained(ARCHITECTURE), sampler=Oracle(ARCHITECTURE, data, index))
    samples = protocols.fed_with_truth(ats, context, future, 4, np.random.default_rng(0))
    for name in protocols.PLAN_SCORES:
        np.testing.assert_allclose(protocols.SCORES[name](samples, future), 0, atol=2e-3, err_msg=name)


def test_bodies_of_one_stage_are_guided_as_ours():
    sampling = PlanSamplingConfig(guidance=1.75, companions_guidance=(0.5, 1.5))
    ours, one_stage = (
        untrained(replace(ARCHITECTURE, family=family)).sampler for family in ("diffusion", "one_stage")
    )
    levels = ours.guidance(sampling), ours.guidance(sampling.for_bodies())
    for whole, path, body in zip(one_stage.guidance(sampling), *levels, strict=True):
        assert set(whole[:PATH_CHANNELS, 0]) == {path} and set(whole[PATH_CHANNELS:, 0]) == {body}
        assert len(whole) == PATH_CHANNELS + ARCHITECTURE.body_channels


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"family": "gaussian"},
        {"family": "one_stage"},
        {"control": "concatenation"},
        {"ego": "world"},
        {"future": 40},
    ],
    ids=lambda changes: "-".join(map(str, changes.values())) or "ats",
)
def test_every_method_runs_through_its_protocols(changes):
    architecture = replace(ARCHITECTURE, **changes)
    data = wandering().with_horizon(architecture.future)
    found = protocols.scores(untrained(architecture), data, architecture.family, EFFORT)
    assert ("truth_fed/path_minade_m" in found) == (architecture.family != "one_stage")
    for protocol in ("end_to_end", "networks"):
        assert len(found["goal_window"]) == len(found[f"{protocol}/goal_minde_m"]) > 1
        assert len(found["plan_window"]) == len(found[f"{protocol}/path_minade_m"])
    assert found["networks/solid"].shape == found["end_to_end/solid"].shape
    assert all(np.isfinite(value).all() for name, value in found.items() if "/" in name)
    assert (found["goal_window"][:, 0] == 2).all()
    again = protocols.scores(untrained(architecture), data, architecture.family, EFFORT)
    assert found["recorded/solid"].tolist() == again["recorded/solid"].tolist()


def test_windows_are_observed_in_their_own_scene():
    data, open_room = wandering(), room()
    walls = replace(open_room, occupancy=np.ones_like(open_room.occupancy), features=open_room.features * 0)
    scenes = Scenes((open_room, walls), (open_room.occupancy != 1, walls.occupancy != 1), np.array([0, 0, 1]))
    context, future = data.windows(np.array([0, len(data.start) - 1]))
    assert scenes.inside_solid(future.path_world, context.video).mean(1).tolist() == [0, 1]
    unknown = Scenes.of(replace(open_room, occupancy=np.full_like(open_room.occupancy, 2)))
    assert not unknown.inside_solid(future.path_world + 100, None).any()
    grids = scenes.around(context.world_from_agent[:, -1], context.video)
    assert np.abs(grids[0]).max() > 0 and np.abs(grids[1]).max() == 0


def test_flight_rate_is_that_of_the_animal():
    steps = np.concatenate([np.zeros(8), np.linspace(0, 2, 56)])
    poses = np.tile(np.eye(4), (2, 3, 64, 1, 1))
    poses[0, :, :, 2, 3] = steps
    observer = np.tile(np.array([0.0, 1.2, -1.0]), (2, 3, 8, 1))
    met = RecordedApproaches(
        poses, np.tile(REST.astype(np.float32), (2, 3, 8, 1, 1, 1)), observer, Scenes.of(room())
    )
    found = approaches.flight_shares(untrained(ARCHITECTURE), met, 2, 0)
    assert found["flees/true"].tolist() == [1, 1, 1]
    assert found["flees/true_standing"].tolist() == [0, 0, 0]
    assert found["flees/seen"].shape == (3,)


def test_gaussian_samples_have_the_predicted_moments():
    class FixedNetworks:
        def perceive(self, grid, others, past, keep):
            return np.zeros((len(past), 1), np.float32)

        def goal(self, x, t, condition):
            return np.full_like(x, 2.0 if t[0] == samplers.MEAN_STEP else np.log(0.5))

        def path(self, x, t, condition, control, keep):
            return np.ones_like(x) if t[0] == samplers.MEAN_STEP else np.full_like(x, -9)

    scaling = Scaling(np.full(3, 0.3), np.ones(4), np.ones((3, 56)), np.zeros(6), np.ones(6))
    sampler = samplers.GaussianSampler(FixedNetworks(), STANDARD, scaling)
    codes = sampler.codes(behavior_observation(), PlanSamplingConfig(), 4000)
    goals = sampler.goals(codes, np.random.default_rng(0))
    drawn = scaling.scaled_goal(goals)
    np.testing.assert_allclose([drawn.mean(), drawn.std()], [2, 0.5], rtol=0.03)
    codes = sampler.codes(behavior_observation(), PlanSamplingConfig(), 99)
    path = sampler.plan_paths(codes, np.random.default_rng(0))
    np.testing.assert_allclose(path.mean(0), np.ones((56, 3)), atol=0.005)
    np.testing.assert_allclose(path.std(), np.exp(samplers.LOG_STD_BOUNDS[0]), rtol=0.03)


@pytest.mark.parametrize(
    ("method", "steps", "calls"), [("dpm_solver", 0, 9), ("ddpm", 0, 50), ("ddpm", 10, 9)]
)
def test_networks_alone_sample_by_the_schedule_and_do_not_snap_to_goals(method, steps, calls):
    class CountingNetworks:
        def __init__(self):
            self.calls = 0

        def perceive(self, grid, others, past, keep):
            return np.zeros((len(past), 1), np.float32)

        def path(self, x, t, condition, control, keep):
            self.calls += 1
            return x

    scaling = Scaling(np.ones(3), np.ones(4), np.ones((3, 56)), np.zeros(6), np.ones(6))
    counted = CountingNetworks()
    sampler, goal = Sampler(counted, replace(STANDARD, method=method), scaling), np.full((4, 3), 2.0)
    snapped = PlanSamplingConfig(guidance=1.0, max_path_draws=1, sequence_steps=steps)
    alone, ends = snapped.networks_only(), []
    for sampling in (snapped, alone):
        codes, rng = sampler.codes(behavior_observation(), sampling, 4), np.random.default_rng(0)
        ends.append(np.abs(sampler.paths(codes, goal, rng)[:, -1] - goal).max())
    assert counted.calls == 2 * calls
    assert ends[0] < ends[1]
    assert not alone.avoid_solid


def behavior_observation():
    return Observation(
        np.zeros((1, 16, 64, 8, 64), np.float32),
        np.zeros((1, 1, 8, 10), np.float32),
        np.zeros((1, 72), np.float32),
    )
