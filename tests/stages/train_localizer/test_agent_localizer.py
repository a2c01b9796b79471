"""The agent localizer works from all directions and distances; the scene localizer requires a map."""

import numpy as np
import pytest
import trimesh

from pipeline.backends.descriptors import Describer
from pipeline.core.errors import InputError
from pipeline.data.templates import SkinTable
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh, RayCaster
from pipeline.localization.patches import Patches
from stages.train_localizer import described_views, training, views
from stages.train_localizer.config import AgentConfig, Config, SceneConfig
from tests.pipeline.fields.test_limbs import chain
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


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_crops_scale_with_the_animal(factor):
    """Larger and from farther away, its patches are the same, and tolerances are larger."""
    mesh = trimesh.creation.capsule(0.3, 0.1, count=(32, 32))
    colors = noise_color(8 * mesh.vertices, 1)

    def shown(factor: float) -> tuple[training.TrainingViews, Patches]:
        body = Mesh((factor * mesh.vertices).astype(np.float32), mesh.faces.astype(np.int32), colors)
        data = training.agent_views(body, AgentConfig(views=0), np.random.default_rng(0))
        camera = rigid.look_at(factor * np.array([1.2, 0.5, 0.2]), np.zeros(3), np.array([0, 1.0, 0]))
        lens = np.array([[220.0, 0, 120], [0, 220, 120], [0, 0, 1]])
        view = views.render(RayCaster(body), camera, lens, (240, 240), np.random.default_rng(0))
        return data, described_views.describe_view(view, data.sampling, None)

    (unit, patches), (data, others) = shown(1.0), shown(factor)
    np.testing.assert_array_equal(others.cell, patches.cell)
    np.testing.assert_allclose(others.points_camera, factor * patches.points_camera, rtol=1e-4)
    np.testing.assert_allclose(others.descriptors, patches.descriptors, atol=0.02)
    assert data.solver.threshold_m == pytest.approx(factor * unit.solver.threshold_m)
    assert data.solver.min_side_m == pytest.approx(factor * unit.solver.min_side_m)


def test_map_that_fills_no_view_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "MAX_DRAWS", 5)
    truth = walk(4)
    clip = MemoryClip(RayCaster(textured_room(edge_m=0.5)), truth, truth, folder=tmp_path)
    crumb = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), np.full((3, 3), 9, np.uint8))
    with pytest.raises(InputError, match="MAP-006"):
        training.scene_views(crumb, truth, 0.0, clip, SceneConfig(), np.random.default_rng(0))


def test_frames_without_a_registered_camera_are_no_views(tmp_path):
    mesh, truth = textured_room(edge_m=0.2), walk(12)
    clip, walked = MemoryClip(RayCaster(mesh), truth, truth, folder=tmp_path), truth.copy()
    walked[4:9] = np.nan
    data = training.scene_views(
        mesh, walked, 0.0, clip, SceneConfig(views=3, frames=20), np.random.default_rng(0)
    )
    assert len(data.pictures) == 3 + 7
    assert all(np.isfinite(view.map_from_camera).all() for view in data.pictures)


def test_views_show_postures_with_the_root_bone_at_rest():
    points, weights, bones = (part.numpy() for part in chain())
    side = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]]) * 0.02
    vertices = (points[:, None] + side).reshape(-1, 3).astype(np.float32)
    first = np.arange(0, len(vertices) - 3, 3)
    faces = np.concatenate([first[:, None] + corner for corner in ((0, 1, 3), (1, 2, 4), (2, 0, 5))])
    mesh = Mesh(vertices, faces.astype(np.int32), noise_color(vertices, 0))
    skin = SkinTable(np.repeat(weights, 3, axis=0), bones, np.full((5, 3), 0.04, np.float32))
    still, moved = (
        np.stack([draw(np.random.default_rng(seed)).vertices for seed in range(60)])
        for draw in (views.postures(mesh, skin, degrees) for degrees in (0.0, 10.0))
    )
    np.testing.assert_allclose(still, np.broadcast_to(vertices, still.shape), atol=1e-6)
    off = np.linalg.norm(moved - vertices, axis=-1).mean(0)
    assert off[np.abs(vertices[:, 2]) < 0.03].max() < 0.002, "the root bone carries the agent's frame"
    lever = np.array([0.27, 0.17, 0.07])  # from the tail's joints to its tip, meters
    rayleigh_mean = np.deg2rad(10) * np.linalg.norm(lever) * np.sqrt(np.pi / 2)
    assert abs(off[:3].mean() / rayleigh_mean - 1) < 0.25, "four standard errors of 60 postures"
    config = AgentConfig(views=3, posture_deg=10.0)
    at_rest, posed = (
        training.agent_views(mesh, config, np.random.default_rng(0), each).pictures[0]
        for each in (None, skin)
    )
    np.testing.assert_array_equal(at_rest.map_from_camera, posed.map_from_camera)
    assert (at_rest.seen != posed.seen).any(), "the same camera shows another posture"
