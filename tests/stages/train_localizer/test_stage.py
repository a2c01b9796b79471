"""The stage with DINOv2 descriptors, and the regressor with views rendered during training."""

import json

import numpy as np
import pytest
import torch
import trimesh

from pipeline.backends.descriptors import Describer
from pipeline.core.errors import InputError
from pipeline.data import ply
from pipeline.geometry.meshes import Mesh
from pipeline.localization import localizer as localizers
from stages.train_localizer import networks, stage, training
from stages.train_localizer.config import AgentConfig, Config, NetworkConfig
from tests.pipeline.backends import small_checkpoints
from tests.stages.textured_room import noise_color


def textured_boxes() -> Mesh:
    """Return an animal of two boxes with a random texture."""
    boxes = [
        trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))
        for size, at in (((0.16, 0.16, 0.4), (0, 0, 0)), ((0.12, 0.13, 0.14), (0, 0.12, 0.24)))
    ]
    whole = trimesh.util.concatenate(boxes)
    vertices, faces = trimesh.remesh.subdivide_to_size(whole.vertices, whole.faces, 0.03, max_iter=10)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), noise_color(vertices * 3, 1))


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent_template")
    ply.write_ply(folder / "agent.ply", textured_boxes())
    return folder


def test_patches_use_the_descriptors_of_the_features(template, tmp_path):
    """With the DINOv2 backend the localizer uses DINOv2 tokens in training and queries, also after reloading."""
    basis, out = tmp_path / "feature_basis", tmp_path / "localizer"
    basis.mkdir()
    out.mkdir()
    weights = str(small_checkpoints.dinov2(tmp_path / "dinov2"))
    Describer("dinov2", weights).save(basis)
    config = Config(target="agent", agent=AgentConfig(views=6, held_out=3))
    localizer = stage.run(stage.Inputs(feature_basis=basis, agent_template=template), config, out)
    assert localizer.basis.mean.shape == (24,), "channels of the checkpoint, not DAISY's"
    table = json.loads((out / "localizer.json").read_text())
    assert table["describer"] == {"backend": "dinov2", "weights": weights}
    again = localizers.load(out)
    view = training.agent_views(
        ply.read_ply(template / "agent.ply"), config.agent, np.random.default_rng(5)
    ).pictures[0]
    camera = (view.intrinsics, view.intrinsics)
    first, second = (each.localize(view.color, view.depth, *camera, view.seen) for each in (localizer, again))
    assert [a.inlier_ratio for a in first] == [a.inlier_ratio for a in second]


def test_target_requires_its_template(tmp_path):
    with pytest.raises(InputError, match="ART-001.*agent_template|agent_template.*ART-001"):
        stage.run(stage.Inputs(), Config(target="agent"), tmp_path)


def test_the_regressor_learns_from_views_rendered_on_the_fly(template, monkeypatch):
    """Every step replaces the oldest views together with their ground truth."""
    mesh, rng = ply.read_ply(template / "agent.ply"), np.random.default_rng(0)
    network = NetworkConfig(steps=4, pose_width=8, batch_views=4, fresh_views=3)
    config = Config(
        target="agent", kind="regression", agent=AgentConfig(views=6, held_out=2), network=network
    )
    shown = training.agent_views(mesh, config.agent, rng)
    replaced = []
    original = networks.PoseSamples.replace

    def counted(self, *arguments):
        before = self.rotation.clone()
        original(self, *arguments)
        replaced.append(int((self.rotation != before).any((1, 2)).nonzero()[0]))

    monkeypatch.setattr(networks.PoseSamples, "replace", counted)
    localizer, _ = training.train(shown, config, Describer(), "cpu", rng)
    assert replaced == [index % 6 for index in range(12)], "three of six views a step, oldest first"
    assert all(torch.isfinite(value).all() for value in localizer.model.state_dict().values())
