import os
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from pipeline.baselines import longterm_networks
from pipeline.core.errors import InputError
from pipeline.longterm import examples
from pipeline.longterm.config import LongTermSizes
from pipeline.longterm.examples import DatasetSplit
from pipeline.longterm.networks import PointNet
from stages.train_longterm import learning, objectives, pictures, training
from stages.train_longterm.config import Config
from stages.train_longterm.training import LongTermLossWeights, LongTermOptimizerConfig, NetworkTrainer
from tests.pipeline.longterm import strider

SIZES = LongTermSizes(pose=12, latent=4, scene=16, hidden=12, width=24, points=32)
SHORT = LongTermOptimizerConfig(epochs=34, batch=16, rate=1e-2)
"""81 steps on the 38 clips of `dataset`"""
BODY = LongTermOptimizerConfig(epochs=12, batch=16, rate=1e-2)


SETTINGS = Config(body=BODY, route=SHORT, pose=SHORT, clip_stride=10, max_bodies=120)


@pytest.fixture(scope="module")
def dataset():
    return strider.dataset(count=2)


@pytest.fixture(scope="module")
def learned(dataset):
    return learning.train_networks(dataset, SETTINGS, sizes=SIZES)


@pytest.mark.slow
def test_every_network_learns(learned):
    for name, record in learned.records.items():
        total = record.total()
        assert np.mean(total[-8:]) < 0.9 * np.mean(total[:4]), name


def test_training_is_deterministic_and_ablations_are_written(dataset, learned, tmp_path):
    one = LongTermOptimizerConfig(epochs=0.2, batch=4)
    settings = replace(SETTINGS, body=one, route=one, pose=one, ablations="all")
    first = learning.train_networks(dataset, settings, sizes=SIZES)
    second = learning.train_networks(dataset, replace(settings, ablations="none"), sizes=SIZES)
    for name in ("static", "route", "pose"):
        for key, value in getattr(first.model, name).state_dict().items():
            assert torch.equal(value, getattr(second.model, name).state_dict()[key]), f"{name}.{key}"
    assert set(first.ablated) == set(longterm_networks.ABLATIONS)
    learning.write_ablations(tmp_path, first)
    again = longterm_networks.load(
        tmp_path / "ablations" / "base.safetensors", longterm_networks.ABLATIONS["base"], SIZES
    )
    for key, value in first.ablated["base"].state_dict().items():
        assert torch.equal(value, again.state_dict()[key])


@pytest.mark.parametrize("label", ["body", "route", "pose"])
def test_interrupted_training_resumes_exactly(dataset, tmp_path, monkeypatch, label):
    settings = replace(SETTINGS, **dict.fromkeys(("body", "route", "pose"), replace(SHORT, epochs=3)))
    whole = learning.train_networks(dataset, settings, sizes=SIZES).model
    fit, stopped_at = training.fit, 4

    def interrupted(**arguments):
        loss = arguments["loss"]

        def stopping(step, generator):
            if step == stopped_at:
                os.kill(os.getpid(), signal.SIGTERM)
            return loss(step, generator)

        return fit(**arguments | ({"loss": stopping} if arguments["label"] == label else {}))

    monkeypatch.setattr(training, "fit", interrupted)
    monkeypatch.setattr(training, "SAVE_EVERY", 3)
    with pytest.raises(SystemExit, match="75"):
        learning.train_networks(dataset, settings, sizes=SIZES, resume=tmp_path)
    stopped_at = -1
    assert (tmp_path / label / "step000000005.pt").is_file()
    resumed = learning.train_networks(dataset, settings, sizes=SIZES, resume=tmp_path)
    assert all(len(record.total()) > 5 for record in resumed.records.values())
    for name in ("static", "route", "pose"):
        again = getattr(resumed.model, name).state_dict()
        for key, value in getattr(whole, name).state_dict().items():
            assert torch.equal(value, again[key]), f"{name}.{key}"


def test_training_is_longer_with_more_examples(dataset):
    poses = examples.fit_pose_space(dataset.stretches, dataset.body.agent_from_bone_rest, SIZES.pose)
    trainer, net = NetworkTrainer(poses, LongTermLossWeights(), 0), torch.nn.Linear(1, 1)
    seen: list[torch.Tensor] = []

    def loss(index: torch.Tensor) -> dict[str, torch.Tensor]:
        seen.append(index)
        return {"all": net(torch.ones(1)).sum()}

    for count, steps in ((64, 12), (160, 30), (1, 1)):
        seen.clear()
        record = trainer.train("net", net, LongTermOptimizerConfig(epochs=3, batch=16), loss, count)
        assert len(record.total()) == len(seen) == steps
        assert max(int(index.max()) for index in seen) < count


def test_point_nets_start_from_given_weights(tmp_path):
    given = PointNet(SIZES.scene)
    save_file(given.state_dict(), tmp_path / "net.safetensors")
    settings = replace(SETTINGS, point_net=str(tmp_path / "net.safetensors"))
    made = learning.initialized(lambda: learning.PoseNet(SIZES), settings)
    for key, value in given.state_dict().items():
        assert torch.equal(value, made.between.point_net.state_dict()[key])
    with pytest.raises(InputError, match="LTM-002"):
        learning.initialized(
            lambda: learning.PoseNet(SIZES), replace(SETTINGS, point_net=str(tmp_path / "none"))
        )
    with pytest.raises(InputError, match="LTM-002"):
        learning.initialized(lambda: learning.PoseNet(replace(SIZES, scene=8)), settings)


def test_body_in_the_block_collides_and_body_in_the_air_has_no_contact(dataset, learned):
    model = learned.model
    distance = [dataset.scenes[0].distance]
    surface = learning.training.PosedSurface(
        dataset.body, np.concatenate([np.arange(40), model.contacts.vertices])
    )
    upright = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0, 1, 0, *[0.0] * SIZES.pose]])
    errors = {}
    for name, place in (
        ("stands", [1.2, strider.HIP_M, 1.2]),
        ("floats", [1.2, 0.5, 1.2]),
        ("inside", [0.0, 0.3, 0.0]),
    ):
        frame = torch.eye(4)[None].clone()
        frame[0, :3, 3] = torch.tensor(place)
        mesh = objectives.posed_vertices(upright, frame, model.poses, surface)
        errors[name] = [
            float(e) for e in objectives.scene_errors(mesh, torch.zeros(1, dtype=torch.long), distance, 40)
        ]
    assert errors["inside"][0] > 0.05 > errors["stands"][0] > -1e-6
    assert errors["floats"][0] == 0
    assert errors["floats"][1] > 0.9 > 0.5 > errors["stands"][1]


def test_divergence_is_zero_for_a_standard_normal():
    assert objectives.kl_divergence(torch.zeros(3, 4), torch.zeros(3, 4)) == 0
    assert objectives.kl_divergence(torch.ones(3, 4), torch.zeros(3, 4)) == pytest.approx(0.5)


def test_pictures_show_held_out_motion(dataset, learned):
    checks, shown = pictures.evaluate_held_out(
        learned, DatasetSplit(dataset, strider.dataset(seed=5, count=1)), 0
    )
    assert {picture.name for picture in shown} == {"losses", "routes"}
    assert all(np.isfinite(check.value) for check in checks)
    assert any("held-out routes" in check.name for check in checks)
    checks, _ = pictures.evaluate_held_out(learned, DatasetSplit(dataset, None), 0)
    assert not any("held-out" in check.name for check in checks), "training motion is not called held out"
