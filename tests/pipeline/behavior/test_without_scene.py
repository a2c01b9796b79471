"""Models without a scene encoder: no map, no grid, no export."""

import numpy as np
import pytest
import torch

from pipeline.behavior.model import Architecture, BehaviorNets
from pipeline.behavior.perception import GRID_SHAPE, FeatureVolume
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import BehaviorData
from pipeline.core.errors import InputError
from stages.train_behavior.config import Config
from stages.train_behavior.refusals import check_settings
from tests.pipeline.behavior.wandering import wandering


def test_scene_is_not_perceived():
    architecture = Architecture(bones=1, scene="none", scene_channels=0, ensemble_size=2)
    nets = BehaviorNets(architecture)
    assert architecture.map_cells == 0 and nets.goal.map is None
    batch = 3
    grid = torch.zeros(batch, 0, *GRID_SHAPE)
    others, past = torch.zeros(batch, 1, 8, 10), torch.randn(batch, 8 * 15)
    code = nets.perception(grid, others, past, torch.ones(batch, 3))
    assert code.shape == (batch, architecture.condition_length)
    kept = nets.perception(grid, others, past, torch.tensor([[0.0, 1.0, 1.0]]).expand(batch, 3))
    torch.testing.assert_close(code, kept)


def test_scenes_without_features_keep_occupancy():
    occupancy = np.zeros((4, 4, 4), np.uint8)
    occupancy[1] = 1
    scenes = Scenes.of(FeatureVolume(np.ones((5, 4, 4, 4), np.float16), occupancy, np.zeros(3), 0.1))
    less = scenes.without_features()
    assert less.channels == 0 and scenes.channels == 5
    assert less.around(np.eye(4)[None], None).shape == (1, 0, *GRID_SHAPE)
    points = np.full((1, 1, 3), 0.15)
    assert less.inside_solid(points, None) == scenes.inside_solid(points, None)


def test_export_is_refused():
    data: BehaviorData = wandering()
    architecture = Architecture(bones=1, scene="none", scene_channels=0)
    with pytest.raises(InputError, match="without a scene encoder"):
        check_settings(Config(scene="none"), data, architecture, "here")
    check_settings(Config(scene="none", export=False), data, architecture, "here")
