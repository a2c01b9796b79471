"""Photometric checks of depth, intrinsics and poses, and detection of the correct interpretation."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pipeline.geometry.meshes import RayCaster, render_view
from pipeline.mapping import picture_agreement
from pipeline.mapping.picture_agreement import PosedPicture
from tests.stages import textured_room

APART, CLOCK = 4, 2
"""frames between the pictures of a pair, and offset of delayed pictures"""


@cache
def _recording(seed: int = 0, frames: int = 40) -> list[PosedPicture]:
    """A walk through a textured room with LiDAR noise and changing light."""
    mesh = textured_room.textured_room(seed, edge_m=0.06)
    caster, size, rng = RayCaster(mesh), textured_room.SIZE, np.random.default_rng(seed)
    walked = textured_room.walk(frames + 2 * CLOCK, seed=7)
    depth, gray = [], []
    for camera in walked:
        rendered, hits = render_view(caster, camera, textured_room.INTRINSICS, *size)
        depth.append((rendered + rng.normal(0, 0.005, size)).astype(np.float32))
        light = rng.uniform(0.5, 1.0), rng.normal(0, 3, size)
        color = hits.interpolate(mesh, mesh.color).reshape(*size, 3).mean(-1)
        gray.append(np.clip(light[0] * color + light[1], 0, 255).astype(np.uint8))
    rows = {step: step for step in (0, *picture_agreement.CLOCKS)}
    return [
        PosedPicture(
            gray[row],
            textured_room.INTRINSICS,
            {clock: depth[row + step] for clock, step in rows.items()},
            textured_room.INTRINSICS,
            {clock: walked[row + step] for clock, step in rows.items()},
        )
        for row in range(CLOCK, CLOCK + frames)
    ]


def _check(pictures: list[PosedPicture]) -> picture_agreement.PictureAgreement:
    return picture_agreement.check(list(zip(pictures[:-APART], pictures[APART:], strict=True)), 0.1)


def _depth(factor):
    return lambda each: replace(each, depth={clock: factor * depth for clock, depth in each.depth.items()})


def _intrinsics(change):
    def faulty(each):
        read = change(textured_room.INTRINSICS.copy())
        return replace(each, intrinsics=read, depth_intrinsics=read)

    return faulty


def _focal(factor):
    return _intrinsics(lambda read: read * np.array([[factor], [factor], [1]]) + (1 - factor) * _center(read))


def _center(read):
    return np.array([[0, 0, read[0, 2]], [0, 0, read[1, 2]], [0, 0, 0]])


def _moved(read):
    height, width = textured_room.SIZE
    return read + np.array([[0, 0, 0.05 * width], [0, 0, 0.05 * height], [0, 0, 0]])


def _mirrored(*parts):
    def faulty(each):
        depth = {clock: depth[:, ::-1] for clock, depth in each.depth.items()}
        return replace(
            each,
            gray=each.gray[:, ::-1] if "picture" in parts else each.gray,
            depth=depth if "depth" in parts else each.depth,
        )

    return faulty


def _late(frames):
    def faulty(each):
        nothing = np.zeros_like(each.depth[0])
        return replace(each, depth={step: each.depth.get(step - frames, nothing) for step in each.depth})

    return faulty


FAULTS = {
    "depth times 0.9": _depth(1.1),
    "depth times 2": _depth(0.5),
    "a focal length times 0.9": _focal(1.1),
    "a principal point moved by -5 and -5 % of width and height": _intrinsics(_moved),
    "mirrored pictures": _mirrored("picture"),
    "mirrored depth": _mirrored("depth"),
    "mirrored pictures and depth": _mirrored("picture", "depth"),
    "depth 0.2 s later": _late(2),
    "depth 0.2 s earlier": _late(-2),
}


@pytest.mark.parametrize("right", FAULTS)
def test_fault_is_identified(right):
    found = _check([FAULTS[right](each) for each in _recording()])
    assert (found.verdict, found.better) == ("contradict", right), found
    assert right in found.reason
    assert found.better_correlation > found.correlation


@pytest.mark.parametrize("seed", range(4))
def test_correct_recording_agrees(seed):
    found = _check(_recording(seed))
    assert found.verdict == "agree", found
    assert found.correlation > 0.5


def test_unrelated_poses_are_not_confirmed():
    pictures, others = _recording(), textured_room.walk(40, seed=2)
    elsewhere = [
        replace(each, world_from_camera=dict.fromkeys((0, *picture_agreement.CLOCKS), pose))
        for each, pose in zip(pictures, others[::-1], strict=True)
    ]
    assert _check(elsewhere).verdict == "unconfirmed"


def test_small_errors_are_tolerated():
    """Hypotheses differ by 10 %, so the 1 % calibration error of a good phone stays closest to no fault."""
    for fault in (_depth(1.01), _focal(0.99)):
        assert _check([fault(each) for each in _recording()]).verdict == "agree"


def test_too_few_pictures_are_untested():
    assert _check(_recording()[:10]).verdict == "untested"
    still = [
        replace(each, depth={clock: 0 * depth for clock, depth in each.depth.items()})
        for each in _recording()
    ]
    assert _check(still).verdict == "untested"
