"""Behavior is evaluated on a simulated second device."""

from dataclasses import replace

import numpy as np
import torch

from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.model import BehaviorNets, Scaling
from pipeline.behavior.trajectories import BehaviorData
from pipeline.metrics.metrics import Metrics
from stages.evaluate import stage
from stages.evaluate.config import Config
from stages.train_behavior.export import write_contract
from tests.pipeline.behavior import wandering
from tests.pipeline.environments.small_world import write_volume
from tests.simulated_device import DEVICE, simulated_device
from tests.stages.export_simulator import small_world

ARCHITECTURE = replace(wandering.ARCHITECTURE, bones=small_world.BONES, ensemble_size=1)
SETTINGS = Config(samples=2, trials=1, plan_windows=1, time_plans=False)


def _scaling() -> Scaling:
    channels, plain = ARCHITECTURE.body_channels, wandering.scaling()
    mean = np.zeros(channels)
    mean[[0, 4]] = 1.0
    return replace(plain, body_mean=mean, body_std=np.full(channels, 0.05))


def test_behavior_is_evaluated_on_another_device(tmp_path):
    folders = [tmp_path / name for name in ("metrics", "reconstruction", "data", "behavior", "out")]
    for folder in folders:
        folder.mkdir()
    metrics, reconstruction, data, behavior, out = folders
    Metrics().write(metrics, "metrics.json")
    small_world.write_surfaces(reconstruction)
    tracks = {f"v{2 + k:03d}": small_world.trajectory(70, k) for k in range(2)}
    one_each = np.arange(2, dtype=np.int32), np.zeros(2, np.int32), np.array([False, True])
    BehaviorData(tracks, small_world.rest(), *one_each, tuple(tracks)).save(data)
    write_volume(data / "volume.npz", wandering.room())
    torch.manual_seed(0)
    write_contract(
        behavior, BehaviorNets(ARCHITECTURE), ARCHITECTURE, _scaling(), Schedule(), small_world.rest()
    )
    with simulated_device():
        found = stage.run(stage.Inputs(*folders[:4]), SETTINGS, out, device=DEVICE).values
    names = ("behavior/ats/goal_minde_m", "behavior/ats/penetration_m", "behavior/physical_windows")
    assert all(found[name] is not None and np.isfinite(found[name]) for name in names)
