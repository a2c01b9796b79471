"""Localizers of both kinds are trained, written and queried on a simulated second device."""

import numpy as np
import pytest
import torch

from pipeline.backends.descriptors import Describer
from pipeline.data import ply
from pipeline.localization import localizer as localizers
from stages.train_localizer import networks, stage, training
from stages.train_localizer.config import AgentConfig, Config, NetworkConfig
from tests.pipeline.backends import small_checkpoints
from tests.simulated_device import DEVICE, is_on_device, simulated_device
from tests.stages.train_localizer.test_kinds import described
from tests.stages.train_localizer.test_stage import textured_boxes

ANIMAL = AgentConfig(views=4, held_out=2)
CASES = {
    "bank": ("bank", "dinov2", 0),
    "fixed views": ("regression", "daisy", 0),
    "fresh views": ("regression", "dinov2", 2),
}


@pytest.mark.parametrize(("kind", "backend", "fresh_views"), CASES.values(), ids=CASES)
def test_localizers_are_trained_on_another_device(kind, backend, fresh_views, tmp_path):
    template, basis, out = (tmp_path / name for name in ("agent_template", "feature_basis", "localizer"))
    for folder in (template, basis, out):
        folder.mkdir()
    ply.write_ply(template / "agent.ply", textured_boxes())
    weights = str(small_checkpoints.dinov2(tmp_path / "dinov2")) if backend == "dinov2" else ""
    Describer(backend, weights).save(basis)
    network = NetworkConfig(steps=2, pose_width=8, batch_views=3, fresh_views=fresh_views)
    config = Config(target="agent", kind=kind, agent=ANIMAL, network=network)
    view = training.agent_views(textured_boxes(), ANIMAL, np.random.default_rng(5)).pictures[0]
    with simulated_device():
        trained = stage.run(stage.Inputs(basis, agent_template=template), config, out, device=DEVICE)
        again = localizers.load(out, DEVICE)
        if kind == "regression":
            assert all(map(is_on_device, (*trained.model.parameters(), *again.model.state_dict().values())))
        picture = view.color, view.depth, view.intrinsics, view.intrinsics, view.seen
        first, second = (each.localize(*picture) for each in (trained, again))
    third = localizers.load(out).localize(*picture)
    assert [pose.inlier_ratio for pose in first] == [pose.inlier_ratio for pose in second]
    assert [pose.inlier_ratio for pose in first] == [pose.inlier_ratio for pose in third]


@pytest.mark.parametrize("target", ["scene", "agent"])
def test_the_same_regressor_is_trained_on_another_device(target):
    """All random numbers come from the CPU."""
    config = NetworkConfig(steps=3, batch_views=4, pose_width=8)
    plain = networks.train_regressor(described(8, 1), target, config, 0)
    with simulated_device():
        net = networks.train_regressor(described(8, 1), target, config, 0, device=DEVICE).cpu()
    for name, value in net.state_dict().items():
        assert torch.equal(value, plain.state_dict()[name]), name
