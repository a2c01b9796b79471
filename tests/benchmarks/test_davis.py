"""Flow and mask metrics on a synthetic DAVIS sequence with known results."""

import json

import cv2
import numpy as np
import pytest

from benchmarks.real import davis, flow, masks
from pipeline.data.clips import Clip
from pipeline.data.flow import STRIDE_PX, writer

SIZE = (60, 107)
SHIFT_PX = 3


@pytest.fixture
def sequence(tmp_path):
    """A textured square that moves to the right in front of a textured wall, with two joints in three frames."""
    rng = np.random.default_rng(0)
    wall, animal = rng.integers(0, 255, (*SIZE, 3), np.uint8), rng.integers(0, 255, (20, 20, 3), np.uint8)
    pictures, annotated = tmp_path / "JPEGImages/480p/cows", tmp_path / "Annotations/480p/cows"
    for folder in (pictures, annotated, tmp_path / "joint_annotations"):
        folder.mkdir(parents=True)
    entries = []
    for frame in range(4):
        left = 10 + SHIFT_PX * frame
        color, mask = wall.copy(), np.zeros(SIZE, np.uint8)
        color[20:40, left : left + 20], mask[20:40, left : left + 20] = animal, 255
        cv2.imwrite(str(pictures / f"{frame:05d}.jpg"), color)
        cv2.imwrite(str(annotated / f"{frame:05d}.png"), mask)
        place = np.array([[left + 5, 25], [left + 15, 35]]) * davis.FULL_SIZE_PX / SIZE[::-1]
        entry = {"joints": place[:, ::-1].tolist(), "visibility": [True, frame > 0]}
        entries += [entry | {"image_path": f"DAVIS/cows/{frame:05d}.jpg"}] if frame in (0, 2, 3) else []
    (tmp_path / "joint_annotations" / "cows.json").write_text(json.dumps(entries))
    return tmp_path


def test_sequences_and_joints_are_read(sequence):
    (davis_sequence,) = davis.animals(sequence).values()
    joints = davis_sequence.joints_by_frame()
    assert sorted(joints) == [0, 2, 3]
    np.testing.assert_allclose(joints[2].position_px, [[21, 25], [31, 35]])
    assert joints[0].visible.tolist() == [True, False]
    assert davis_sequence.mask(1).sum() == 400
    (sequence / "Annotations/480p/cows/00003.png").unlink()
    assert davis.animals(sequence) == {}


def test_joint_errors_vanish_with_true_flow_and_not_with_zero_flow(sequence):
    (davis_sequence,) = davis.animals(sequence).values()
    true = np.zeros((*SIZE, 2), np.float32)
    true[..., 0] = SHIFT_PX
    np.testing.assert_allclose(
        flow.errors(flow.chained(lambda first, last: true), davis_sequence), 0, atol=1e-6
    )
    without_motion = flow.errors(lambda points, first, last: points, davis_sequence)
    np.testing.assert_allclose(without_motion * 20, [6, 3, 3], rtol=1e-5)


def test_most_certain_selects_the_correct_path():
    """Flow over one frame is wrong at the second point; flow over four frames is correct only there."""

    def step(first, last):
        found, confidence = np.zeros((*SIZE, 2), np.float32), np.full(SIZE, 0.9, np.float32)
        found[..., 0] = SHIFT_PX * (last - first)
        wrong = slice(50, None) if last - first < 4 else slice(None, 50)
        found[:, wrong], confidence[:, wrong] = 0, 0.1
        return found, confidence

    points = np.array([[10.0, 20], [70, 20]])
    predicted = flow.most_certain(step)(points, 0, 4)
    np.testing.assert_allclose(predicted, points + np.array([4 * SHIFT_PX, 0]))
    assert np.array_equal(flow.chained(lambda first, last: step(first, last)[0])(points, 0, 4)[1], points[1])


def test_frames_have_color_and_no_depth(sequence, tmp_path):
    (davis_sequence,) = davis.animals(sequence).values()
    clip = Clip.open(davis.frames(davis_sequence, tmp_path / "frames"))
    assert len(clip) == 4 and clip.color_size == SIZE
    assert not any(clip.depth(frame).any() for frame in range(len(clip)))


def test_iou():
    half = np.zeros((4, 4), bool)
    half[:2] = True
    assert masks.iou(half, half) == 1.0
    assert masks.iou(half, np.ones((4, 4), bool)) == 0.5
    assert masks.iou(half, ~half) == 0.0
    assert masks.iou(half & ~half, half & ~half) == 1.0


def test_grabcut_follows_a_box_along_the_flow(sequence, tmp_path):
    pictures = sequence / "JPEGImages/480p/cows"
    for path in sorted(pictures.glob("*.jpg")):
        color = np.full((*SIZE, 3), 200, np.uint8)
        color[cv2.imread(str(sequence / "Annotations/480p/cows" / f"{path.stem}.png"), 0) > 0] = 40
        cv2.imwrite(str(path), color, [cv2.IMWRITE_JPEG_QUALITY, 100])
    (davis_sequence,) = davis.animals(sequence).values()
    clip = Clip.open(davis.frames(davis_sequence, tmp_path / "frames"))
    cells = (-(-SIZE[0] // STRIDE_PX), -(-SIZE[1] // STRIDE_PX))
    (tmp_path / "flow").mkdir()
    with writer(tmp_path / "flow", 1, len(clip) - 1, cells) as table:
        for _ in range(len(clip) - 1):
            moved = np.tile(np.array([SHIFT_PX, 0], np.float16), (*cells, 1))
            table.append(flow=moved, confidence=np.full(cells, 255, np.uint8))
    found = masks.grabcut_masks(clip, tmp_path / "flow", masks.box_of(davis_sequence.mask(0)))
    assert len(found) == len(clip)
    assert min(masks.iou(each, davis_sequence.mask(frame)) for frame, each in enumerate(found)) > 0.8
