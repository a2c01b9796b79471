"""Every form of the behavior model is trained, sampled and written on a simulated second device."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.baselines.samplers import sampler_of
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.planning import TorchNetworks, observe
from pipeline.behavior.scenes import Scenes
from pipeline.environments.homes import Habitat
from stages.train_behavior import outcome
from stages.train_behavior.config import BehaviorOptimizerConfig, BehaviorTrainingConfig, ObjectiveConfig
from stages.train_behavior.training import train
from tests.pipeline.behavior.wandering import ARCHITECTURE, REST, room, wandering
from tests.simulated_device import DEVICE, is_on_device, simulated_device

STEPS = BehaviorOptimizerConfig(steps=2, goal_steps=1, batch=2, goal_batch=4)
JOINT = replace(STEPS, goal_steps=0)
SMALL = replace(ARCHITECTURE, body_components=0)
PAPER = replace(SMALL, scene="volume", ego="full", observed_past="poses", ensemble_size=1, guided="all")
PAPER_OBJECTIVE = ObjectiveConfig(weighting="noise", joint_dropout=0.1, path_share=1.0, body_share=1.0)
FORMS = {
    "default": (ARCHITECTURE, Schedule(), BehaviorTrainingConfig(optimization=STEPS)),
    "without a body prior": (SMALL, Schedule(), BehaviorTrainingConfig(optimization=STEPS)),
    "paper": (
        PAPER,
        Schedule(steps=8, method="ddpm"),
        BehaviorTrainingConfig(optimization=JOINT, objective=PAPER_OBJECTIVE),
    ),
    "one_stage": (
        replace(ARCHITECTURE, family="one_stage"),
        Schedule(),
        BehaviorTrainingConfig(optimization=JOINT),
    ),
    "gaussian": (
        replace(ARCHITECTURE, family="gaussian", body_components=0),
        Schedule(),
        BehaviorTrainingConfig(optimization=STEPS),
    ),
    "flow": (
        ARCHITECTURE,
        Schedule(course="rectified"),
        BehaviorTrainingConfig(optimization=STEPS, objective=ObjectiveConfig(weighting="flow")),
    ),
}


@pytest.fixture(scope="module")
def data():
    return wandering(videos=2)


@pytest.mark.slow
@pytest.mark.parametrize(("architecture", "schedule", "settings"), FORMS.values(), ids=FORMS)
def test_training_and_sampling_run_on_another_device(data, architecture, schedule, settings, tmp_path):
    scenes = Scenes.of(room())
    context, _ = data.windows(np.arange(1))
    with simulated_device():
        trained = train(
            Habitat.of_one_home(data, scenes), architecture, schedule, settings, seed=0, device=DEVICE
        )
        assert all(map(is_on_device, (*trained.nets.parameters(), *trained.nets.buffers())))
        networks = TorchNetworks(trained.nets, DEVICE)
        sampler = sampler_of(architecture, networks, schedule, trained.scaling)
        sampling = PlanSamplingConfig(goal_steps=2, sequence_steps=0 if schedule.method == "ddpm" else 2)
        seen = observe(context, scenes, REST, architecture.ego)
        plan = sampler.plan(seen, sampling, np.random.default_rng(0), count=2)
        if architecture is ARCHITECTURE:
            outcome.write_trained(tmp_path, trained, architecture, schedule, REST)
            assert not any(map(is_on_device, trained.nets.parameters()))
            assert (tmp_path / "golden.json").exists()
    assert all(np.isfinite(part).all() for part in (plan.goal, plan.path, plan.body))
