"""Visual odometry with depth: correct with texture, a jump without."""

import numpy as np

from pipeline.geometry import rigid
from pipeline.geometry.meshes import RayCaster
from pipeline.mapping.visual_odometry import chain_motions, prepare_frame
from pipeline.metrics.pose_errors import pose_errors
from tests.stages.textured_room import INTRINSICS, MemoryClip, textured_room, walk


def test_motion_is_chained_and_a_textureless_frame_is_a_jump():
    truth = walk(60)[20:28]
    clip = MemoryClip(RayCaster(textured_room()), truth, None)

    def view(frame):
        shown = clip.depth(frame) if frame != 4 else np.zeros(clip.depth_size, np.float32)
        return prepare_frame(clip.color(frame), shown, INTRINSICS, INTRINSICS, np.ones(clip.color_size, bool))

    found = chain_motions(map(view, range(len(truth))), np.random.default_rng(0))
    assert np.flatnonzero(found.jumps).tolist() == [4, 5]
    errors = pose_errors(found.relative_poses.first_from_second, rigid.inverse(truth[:-1]) @ truth[1:])
    assert errors.degrees[~found.jumps[1:]].max() < 0.5, "degrees, steps of 3 degrees"
    assert errors.meters[~found.jumps[1:]].max() < 0.02, "meters, steps of 5 cm"
    assert found.relative_poses.sigma_m[3] > 10 * found.relative_poses.sigma_m[0]


def test_fast_rotation_is_tracked():
    truth = walk(60)[20:25].copy()
    truth[2:] = truth[2:] @ rigid.exp(np.array([0, 0, np.deg2rad(120.0), 0, 0, 0]))
    clip = MemoryClip(RayCaster(textured_room()), truth, None)
    views = (
        prepare_frame(clip.color(i), clip.depth(i), INTRINSICS, INTRINSICS, np.ones(clip.color_size, bool))
        for i in range(5)
    )
    found = chain_motions(views, np.random.default_rng(0))
    assert not found.jumps.any()
    errors = pose_errors(found.relative_poses.first_from_second, rigid.inverse(truth[:-1]) @ truth[1:])
    assert errors.degrees.max() < 1.0, "degrees, one step of 120"
    assert errors.meters.max() < 0.03, "meters"
