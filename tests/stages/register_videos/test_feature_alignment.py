"""Feature-metric alignment of a camera to rendered template features, independent of light."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry import rigid
from pipeline.geometry.meshes import RayCaster, render_view
from pipeline.mapping.pose_optimization import optimize_poses, residuals
from pipeline.metrics.pose_errors import pose_errors
from stages.register_videos import feature_alignment
from stages.register_videos.feature_alignment import FeatureMap, feature_correspondences
from tests.stages.textured_room import MemoryClip, NoAgent, textured_room, walk

CHANNELS = 16


@pytest.fixture(scope="module")
def scene():
    """A room whose features are smooth functions of position, and its view from a camera."""
    mesh, truth = textured_room(edge_m=0.04), walk(8)[3]
    rng = np.random.default_rng(0)
    waves = mesh.vertices @ rng.normal(0, 1.5, (3, CHANNELS)) + rng.uniform(0, 6, CHANNELS)
    vertex = np.sin(waves)
    vertex = (vertex / np.linalg.norm(vertex, axis=1, keepdims=True)).astype(np.float32)
    caster = RayCaster(mesh)
    clip = MemoryClip(caster, truth[None], None, noise_m=0.0)
    intrinsics = clip.intrinsics[0].copy()
    intrinsics[:2] /= feature_alignment.STRIDE_PX
    size = tuple(side // feature_alignment.STRIDE_PX for side in clip.color_size)
    _, hits = render_view(caster, truth, intrinsics, *size)
    seen = hits.interpolate(mesh, vertex).reshape(1, *size, CHANNELS)
    return clip, FeatureMap(caster, vertex, seen / np.linalg.norm(seen, axis=-1, keepdims=True)), truth


def test_alignment_recovers_the_pose(scene):
    clip, features, truth = scene
    moved = truth @ rigid.exp(np.array([0.008, -0.01, 0.004, 0.015, 0.01, -0.01]))
    poses = moved[None]
    for _ in range(4):
        matches = feature_correspondences(clip, NoAgent(1), features, 0, poses[0])
        poses = optimize_poses(poses, lambda *_, found=matches: found, None, reach_m=(0.3,)).world_from_camera
    errors = pose_errors(np.stack([moved, poses[0]]), np.stack([truth, truth]))
    assert errors.degrees[1] < 0.25 * errors.degrees[0]
    assert errors.meters[1] < 0.25 * errors.meters[0]


def test_true_pose_is_a_fixed_point(scene):
    clip, features, truth = scene
    matches = feature_correspondences(clip, NoAgent(1), features, 0, truth)
    assert np.abs(residuals(truth[None], matches)).max() < 1e-4, "meters"


def test_constant_features_do_not_move_the_camera(scene):
    clip, features, truth = scene
    flat = np.full_like(features.frame_features, CHANNELS**-0.5)
    matches = feature_correspondences(clip, NoAgent(1), replace(features, frame_features=flat), 0, truth)
    assert len(matches.first) == 0
    unseen = replace(features, vertex_features=0 * features.vertex_features)
    assert feature_correspondences(clip, NoAgent(1), unseen, 0, truth) is None
