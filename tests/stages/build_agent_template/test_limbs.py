"""Detection of moving limbs and of frames in which a limb has the same pose."""

import numpy as np

from pipeline.geometry.tsdf import Volume
from stages.build_agent_template import appearance
from stages.build_agent_template.fuse import find_limb, limb_region

CELLS = np.stack(np.meshgrid(*[np.arange(-0.1, 0.101, 0.02)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
"""of a static body, 20 cm wide"""


def tail(angle_rad: float) -> np.ndarray:
    """Return points along a tail of 20 cm that swings sideways."""
    along = np.linspace(0.1, 0.3, 30)
    return np.stack([along * np.sin(angle_rad), 0 * along, along * np.cos(angle_rad)], axis=-1)


def measured(angles: np.ndarray) -> tuple[dict, dict]:
    points = {frame: np.concatenate([CELLS[::7], tail(angle)]) for frame, angle in enumerate(angles)}
    return points, {frame: np.ones(len(each)) for frame, each in points.items()}


def test_frames_with_the_same_tail_pose_are_selected():
    angles = 0.6 * np.sin(np.arange(80) * 0.4)
    limb = find_limb(*measured(angles), CELLS)
    assert limb is not None and 12 <= len(limb.frames) < 50
    assert np.ptp(angles[limb.frames]) * 0.3 < 0.09, (
        "meters at the tip: alike within 3 cm to either side of where points are dense"
    )
    volume = Volume(np.array([-0.4, -0.1, -0.1]), (81, 21, 46), 0.01, 0.03)
    there = limb_region(limb, volume)
    tip = np.round((tail(angles.max())[-1] - volume.origin) / 0.01).astype(int)
    assert there[tuple(tip)] and not there[40, 10, 10], (
        "where the limb was, and not in the middle of the body"
    )


def test_static_body_has_no_moving_limb():
    points, above = measured(np.zeros(40))
    still = np.concatenate([CELLS, tail(0.0)])
    assert find_limb(points, above, still) is None


def test_points_on_the_floor_are_no_limb():
    points, above = measured(0.6 * np.sin(np.arange(80) * 0.4))
    assert find_limb(points, {frame: 0 * each for frame, each in above.items()}, CELLS) is None


def test_vertices_outside_the_mask_are_ignored():
    mask = np.zeros((4, 6), np.uint8)
    mask[1, 2] = 255
    pixel = np.array([[2.5, 1.5], [3.1, 1.5], [-1.0, 1.5], [2.5, 9.0]])
    assert appearance.on_mask(pixel, mask).tolist() == [True, False, False, False]
