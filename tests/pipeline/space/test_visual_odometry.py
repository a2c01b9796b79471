"""Motion from pictures with depth: right where there is texture, torn where there is none."""

import numpy as np

from pipeline.models.localizer import errors
from pipeline.space import rigid
from pipeline.space.meshes import RayCaster
from pipeline.space.visual_odometry import FollowOptions, follow, look
from tests.stages.textured_room import INTRINSICS, MemoryClip, textured_room, walk


def test_motion_is_followed_and_a_blind_frame_tears_the_chain():
    truth = walk(60)[20:28]
    clip, options = MemoryClip(RayCaster(textured_room()), truth, None), FollowOptions()

    def view(frame):
        shown = clip.depth(frame) if frame != 4 else np.zeros(clip.depth_size, np.float32)
        return look(clip.color(frame), shown, INTRINSICS, INTRINSICS, np.ones(clip.color_size, bool), options)

    found = follow(map(view, range(len(truth))), options, np.random.default_rng(0))
    assert np.flatnonzero(found.torn).tolist() == [4, 5]
    rotation, distance = errors(found.relatives.first_from_second, rigid.inverse(truth[:-1]) @ truth[1:])
    assert rotation[~found.torn[1:]].max() < 0.5, "degrees, steps of 3 degrees"
    assert distance[~found.torn[1:]].max() < 0.02, "metres, steps of 5 cm"
    assert found.relatives.sigma_m[3] > 10 * found.relatives.sigma_m[0]


def test_a_phone_that_is_swung_about_is_followed():
    truth = walk(60)[20:25].copy()
    truth[2:] = truth[2:] @ rigid.exp(np.array([0, 0, np.deg2rad(120.0), 0, 0, 0]))
    clip, options = MemoryClip(RayCaster(textured_room()), truth, None), FollowOptions()
    views = (look(clip.color(i), clip.depth(i), INTRINSICS, INTRINSICS, np.ones(clip.color_size, bool), options) for i in range(5))
    found = follow(views, options, np.random.default_rng(0))
    assert not found.torn.any()
    rotation, distance = errors(found.relatives.first_from_second, rigid.inverse(truth[:-1]) @ truth[1:])
    assert rotation.max() < 1.0, "degrees, one step of 120"
    assert distance.max() < 0.03, "metres"
