"""A mesh supplied by the recording is used if depth confirms it: metric, upright, colored, with holes where
unobserved.
"""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh, RayCaster
from stages.build_scene_template import own_mesh
from stages.build_scene_template.config import Config, FusionConfig
from tests.stages.textured_room import MemoryClip, aligned_errors, drifting, textured_room, walk

CONFIG = Config(fusion=FusionConfig(feature_frames=4, align_stride_px=14, align_rounds=2))


@pytest.fixture(scope="module")
def clip() -> MemoryClip:
    truth = walk(16)
    return MemoryClip(RayCaster(textured_room(edge_m=0.08)), truth, drifting(truth, 1, deg=0.02, m=0.001))


def _own(clip: MemoryClip, scale: float = 1.0) -> Mesh:
    """The room in the odometry frame without colors, and a block outside that was never observed."""
    room = clip.caster.mesh
    block = textured_room(edge_m=0.5)
    vertices = np.concatenate([room.vertices, block.vertices + np.array([9.0, 0, 0], np.float32)]).astype(
        float
    )
    odometry_from_world = clip.odometry_from_camera[0] @ rigid.inverse(clip.truth[0])
    faces = np.concatenate([room.faces, block.faces + len(room.vertices)])
    moved = rigid.apply(odometry_from_world, scale * vertices)
    return Mesh(moved.astype(np.float32), faces, np.full((len(moved), 3), 128, np.uint8))


def _built(clip: MemoryClip, mesh: Mesh):
    features = np.random.default_rng(0).normal(size=(len(clip), 20, 15, 16))
    return own_mesh.build(clip, features, mesh, CONFIG)


def test_own_mesh_is_metric_upright_and_cropped_to_observed_space(clip):
    made = _built(clip, _own(clip))
    assert made.own_mesh
    rotation, distance = aligned_errors(made.world_from_camera, clip.truth)
    assert np.median(rotation) < 0.5, "degrees"
    assert np.median(distance) < 0.02, "meters"
    up = made.world_from_camera[:, :3, :3] @ np.swapaxes(clip.truth[:, :3, :3], 1, 2) @ np.array([0, 1.0, 0])
    assert np.rad2deg(np.arccos(np.clip(up[:, 1], -1, 1))).max() < 1.5, "degrees between +y and gravity"
    assert np.ptp(made.mesh.vertices, axis=0).max() < 5, "the block that nobody saw is gone"
    camera_height = made.world_from_camera[:, 1, 3].mean() - made.floor_m
    assert abs(camera_height - clip.truth[:, 1, 3].mean()) < 0.06
    assert made.mesh.color.astype(float).std(0).min() > 10, "frames lend it their colors"
    assert len(made.mesh.faces) < len(_own(clip).faces)


@pytest.mark.slow
def test_mesh_of_wrong_scale_or_position_is_refused(clip):
    assert _built(clip, _own(clip, scale=1.1)) is None
    away = _own(clip)
    assert _built(clip, Mesh(away.vertices + np.float32(0.5), away.faces, away.color)) is None
    assert _built(replace(clip, odometry_from_camera=None), _own(clip)) is None
