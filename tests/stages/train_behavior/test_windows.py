"""Past, horizon and rate are settings: windows of other lengths are sliced, learned, sampled and loaded."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.baselines.predictors import Ats, ConstantVelocity
from pipeline.behavior import model
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.path_encoding import path_from_velocity_channels, velocity_channels_from_path
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import TEST, TRAIN, BehaviorData, frames_from_seconds
from pipeline.core.errors import InputError
from pipeline.environments.homes import Habitat
from stages.slice_behavior.gridding import ReconstructedMotion, trajectory_from_motion
from stages.slice_behavior.windows import slice_windows
from stages.train_behavior import export
from stages.train_behavior.config import BehaviorOptimizerConfig, BehaviorTrainingConfig, Config
from stages.train_behavior.refusals import check_settings
from stages.train_behavior.training import train
from tests.pipeline.behavior.wandering import ARCHITECTURE, REST, room, wandering

PAST, RATE_HZ = 6, 5.0


@pytest.fixture(scope="module")
def data() -> BehaviorData:
    tracks = {}
    for name, track in wandering().trajectories.items():
        known = np.ones(len(track.timestamp_s))
        motion = ReconstructedMotion(
            track.timestamp_s, track.world_from_camera, track.world_from_agent,
            track.agent_from_bone.astype(float), known, known > 0,
        )  # fmt: skip
        options = {"min_confidence": 0.0, "max_gap_s": 0.6, "smooth_s": 0.0, "rate_hz": RATE_HZ}
        tracks[name] = trajectory_from_motion(motion, **options)
    rest = REST.astype(np.float32)
    return slice_windows(tracks, frozenset({"v002"}), rest, stride=1, past=PAST, rate_hz=RATE_HZ)


def test_windows_have_the_configured_length(data, tmp_path):
    data.save(tmp_path)
    again = BehaviorData.load(tmp_path)
    assert (again.past, again.future, again.rate_hz) == (PAST, 28, RATE_HZ)
    longer = again.with_horizon(frames_from_seconds(8.0, RATE_HZ))
    context, future = longer.windows(longer.indices(TEST)[:3])
    assert context.world_from_agent.shape[1] == context.observer_world.shape[1] == PAST
    assert future.path_world.shape[1] == 40
    ahead = ConstantVelocity.fit(context, future).sample(context, 4, np.random.default_rng(0))
    assert ahead.path.shape == (3, 4, 40, 3)
    with pytest.raises(InputError, match="BEH-003"):
        frames_from_seconds(0.6, RATE_HZ)


def test_strides_are_meters_per_second_at_any_rate():
    way = torch.tensor([[[0.3, 0.0, 0.4]]]) * torch.arange(1, 9)[None, :, None] / RATE_HZ
    strides = velocity_channels_from_path(way, torch.zeros(1, 3), RATE_HZ)
    torch.testing.assert_close(strides[..., :3].norm(dim=-1).square(), torch.full((1, 8), 0.5))
    again = path_from_velocity_channels(strides.numpy(), np.zeros((1, 3)), RATE_HZ)
    np.testing.assert_allclose(again, way.numpy(), atol=1e-6)


def test_model_with_other_windows_is_trained_loaded_and_sampled(data, tmp_path):
    architecture = replace(ARCHITECTURE, past=data.past, future=data.future, rate_hz=data.rate_hz)
    quick = BehaviorOptimizerConfig(steps=4, goal_steps=2, batch=4, goal_batch=4)
    settings, schedule = BehaviorTrainingConfig(optimization=quick), Schedule()
    fitted = train(Habitat.of_one_home(data, Scenes.of(room())), architecture, schedule, settings, seed=0)
    export.write_contract(tmp_path, fitted.nets, architecture, fitted.scaling, schedule, REST)
    again, _, scaling, *_ = model.load(tmp_path)
    assert again == architecture and scaling.rate_hz == RATE_HZ
    ats = Ats.load(tmp_path, Scenes.of(room()), PlanSamplingConfig(goal_steps=2, sequence_steps=2))
    context, _ = data.windows(data.indices(TRAIN)[:2])
    assert ats.sample(context, 3, np.random.default_rng(0)).path.shape == (2, 3, 28, 3)


def test_unsupported_rates_are_not_exported(data):
    config = Config()
    with pytest.raises(InputError, match="REC-002"):
        check_settings(config, data, ARCHITECTURE, "here")
    check_settings(replace(config, export=False), data, ARCHITECTURE, "here")
