"""Tracking jumps of a walk-through are repaired before its odometry is used."""

from dataclasses import replace

import numpy as np

from pipeline.geometry import rigid
from pipeline.geometry.meshes import RayCaster
from stages.build_scene_template import template
from tests.stages.textured_room import MemoryClip, aligned_errors, drifting, textured_room, walk


def test_jump_is_repaired():
    truth = walk(60)
    odometry = drifting(truth, 4, deg=0.03, m=0.001)
    clip = MemoryClip(RayCaster(textured_room(edge_m=0.5)), truth, odometry)
    assert template.without_jumps(clip) is clip
    odometry = odometry.copy()
    odometry[25:] = rigid.exp(np.array([0, 0.3, 0, 0.3, 0, 0.1])) @ odometry[25:]
    repaired = template.without_jumps(replace(clip, odometry_from_camera=odometry))
    assert aligned_errors(odometry, truth)[1].max() > 0.1, "meters"
    assert aligned_errors(repaired.odometry_from_camera, truth)[1].max() < 0.04, "meters"


def test_recording_without_odometry_is_unchanged():
    clip = MemoryClip(RayCaster(textured_room(edge_m=0.5)), walk(3), None)
    assert template.without_jumps(clip) is clip
