"""The agent localizer works from all directions and distances; the scene localizer requires a map."""

import numpy as np
import pytest
import trimesh

from pipeline.backends.descriptors import Describer
from pipeline.core.errors import InputError
from pipeline.geometry.meshes import Mesh, RayCaster
from stages.train_localizer import training
from stages.train_localizer.config import AgentConfig, Config, SceneConfig
from tests.stages.textured_room import MemoryClip, noise_color, textured_room, walk


@pytest.mark.slow
def test_agent_is_localized_from_all_directions():
    parts = [
        ((0.16, 0.16, 0.4), (0, 0, 0)),
        ((0.12, 0.13, 0.14), (0, 0.12, 0.24)),
        ((0.04, 0.04, 0.2), (0, 0.06, -0.28)),
    ]
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in parts]
    whole = trimesh.util.concatenate(boxes)
    vertices, faces = trimesh.remesh.subdivide_to_size(whole.vertices, whole.faces, 0.02, max_iter=10)
    mesh = Mesh(vertices.astype(np.float32), faces.astype(np.int32), noise_color(vertices * 3, 1))
    config, rng = Config(agent=AgentConfig(views=90, held_out=24)), np.random.default_rng(0)
    shown = training.agent_views(mesh, config.agent, rng)
    localizer, held = training.train(shown, config, Describer(), "cpu", rng)
    assert held.good.mean() > 0.6, "share within 15 degrees and 8 cm"
    assert np.nanmedian(held.rotation_deg) < 8, "degrees"
    assert localizer.calibration.slope > 0


def test_map_that_fills_no_view_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "MAX_DRAWS", 5)
    truth = walk(4)
    clip = MemoryClip(RayCaster(textured_room(edge_m=0.5)), truth, truth, folder=tmp_path)
    crumb = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), np.full((3, 3), 9, np.uint8))
    with pytest.raises(InputError, match="MAP-006"):
        training.scene_views(crumb, truth, 0.0, clip, SceneConfig(), np.random.default_rng(0))
