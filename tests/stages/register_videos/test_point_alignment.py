"""Alignment of session cameras to points of the walk-through."""

import numpy as np

from pipeline.geometry import rigid
from pipeline.geometry.meshes import RayCaster
from pipeline.mapping.pose_optimization import Correspondences, optimize_poses
from pipeline.metrics.pose_errors import pose_errors
from stages.register_videos import point_alignment
from tests.stages.textured_room import MemoryClip, NoAgent, textured_room, walk

NO_INDEX, NO_POINT = np.zeros(0, int), np.zeros((0, 3))
NOTHING = Correspondences(NO_INDEX, NO_INDEX, NO_POINT, NO_POINT, NO_POINT, np.zeros(0))
FRAMES = 6


def test_displaced_cameras_are_corrected():
    caster, path, truth = RayCaster(textured_room()), walk(14), walk(14)[1:13:2].copy()
    truth = truth @ rigid.exp(np.tile([0.03, -0.02, 0.02, 0.03, 0.02, -0.03], (FRAMES, 1)))
    known = path.copy()
    known[::4] = np.nan
    walked = point_alignment.Walkthrough(MemoryClip(caster, path, None), known)
    session = MemoryClip(caster, truth, None)
    start = truth @ rigid.exp(np.random.default_rng(0).normal(0, 1, (FRAMES, 6)) * ([0.01] * 3 + [0.02] * 3))
    term = point_alignment.WalkthroughTerm(session, NoAgent(FRAMES), start, walked)
    found = optimize_poses(start, lambda *_: NOTHING, None, reach_m=(1.0,) * 8, term=term).world_from_camera
    before, after = (pose_errors(poses, truth) for poses in (start, found))
    assert np.median(after.meters) < 0.3 * np.median(before.meters)
    assert np.median(after.degrees) < 0.3 * np.median(before.degrees)
