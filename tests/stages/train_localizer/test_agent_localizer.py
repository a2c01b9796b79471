"""The agent's localizer answers from all around, at any distance, through the crop that depth scales."""

import numpy as np
import trimesh

from pipeline.space.meshes import Mesh
from stages.train_localizer import training
from tests.stages.textured_room import noise_color


def test_agent_is_found_from_all_around():
    parts = [((0.16, 0.16, 0.4), (0, 0, 0)), ((0.12, 0.13, 0.14), (0, 0.12, 0.24)), ((0.04, 0.04, 0.2), (0, 0.06, -0.28))]
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in parts]
    whole = trimesh.util.concatenate(boxes)
    vertices, faces = trimesh.remesh.subdivide_to_size(whole.vertices, whole.faces, 0.02, max_iter=10)
    mesh = Mesh(vertices.astype(np.float32), faces.astype(np.int32), noise_color(vertices * 3, 1))
    options = training.AgentOptions(views=90, held_out=24)
    localizer, held = training.train_agent(mesh, options, np.random.default_rng(0))
    assert held.good.mean() > 0.6, "share within 15 degrees and 8 cm"
    assert np.nanmedian(held.rotation_deg) < 8, "degrees"
    assert localizer.calibration.slope > 0
