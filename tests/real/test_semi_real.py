"""The built-in animal rendered into fifty frames of a real kitchen: ground truth, occlusion, and extraction."""

import dataclasses
import json
import shutil

import cv2
import numpy as np
import pytest

from benchmarks import semi_real
from benchmarks.composited import Sequence
from pipeline.core.errors import InputError
from pipeline.core.videos import Video
from pipeline.data import npz
from pipeline.data.clips import Masks, read_source_index
from pipeline.recordings.formats import open_recording
from stages.estimate_flow import stage as flowing
from stages.estimate_flow.config import Config as FlowConfig
from stages.extract_frames import stage as extracting
from stages.extract_frames.config import Config as FramesConfig
from stages.segment_agent import stage as segmenting
from stages.segment_agent.config import Config
from tests.pipeline.recordings import made_formats
from tests.real.seven_scenes import SCENE
from tests.stages.extract_frames.made_recordings import walk


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    if not SCENE.exists():
        pytest.skip(f"no real kitchen at {SCENE} (set ATS_REALDATA)")
    out = tmp_path_factory.mktemp("semi_real")
    sequence = Sequence.open(SCENE, first=500)
    semi_real.draw(sequence, out, "session-1", seed=1)
    return sequence, out


def test_recording_is_extracted_with_its_ground_truth(drawn):
    sequence, out = drawn
    recording = open_recording(out / "recordings" / "session-1")
    truth = semi_real.read_truth(out / "truth" / "session-1.npz", recording.index)
    assert len(truth) == len(sequence.numbers)
    there = truth.any((1, 2))
    assert 0.15 < there.mean() < 0.9, "the animal comes and goes"


def test_animal_changes_color_and_depth_only_in_its_mask(drawn):
    sequence, out = drawn
    recording = open_recording(out / "recordings" / "session-1")
    truth = semi_real.read_truth(out / "truth" / "session-1.npz", recording.index)
    for row in np.flatnonzero(truth.mean((1, 2)) > 0.01)[:4]:
        before, after = sequence.depth(row), recording.read_depth(int(recording.index[row]))
        known = (before > 0) & (after > 0)
        assert (after <= before + 0.03)[truth[row] & known].mean() > 0.95, "it hides what lies behind"
        assert (np.abs(after - before) < 0.002)[~truth[row] & known].mean() > 0.97
    for row in np.flatnonzero(~truth.any((1, 2)))[:3]:
        np.testing.assert_allclose(
            recording.read_depth(int(recording.index[row])), sequence.depth(row), atol=6e-4
        )


@pytest.fixture(scope="module")
def two_drawn(drawn, tmp_path_factory):
    out = tmp_path_factory.mktemp("two_animals")
    semi_real.draw(drawn[0], out, "session-1", 1, semi_real.RenderConfig(("cat", "rabbit")))
    return out


def test_animals_hide_each_other(drawn, two_drawn):
    _, alone = drawn
    index = open_recording(two_drawn / "recordings" / "session-1").index
    cat, rabbit = (
        semi_real.read_truth(two_drawn / "truth" / name / "session-1.npz", index)
        for name in ("cat", "rabbit")
    )
    before = semi_real.read_truth(alone / "truth" / "session-1.npz", index)
    assert cat.any() and rabbit.any()
    assert not (cat & rabbit).any()
    np.testing.assert_array_equal(before & ~rabbit, cat)
    first, second = (npz.load(two_drawn / "truth" / name / "session-1.npz") for name in ("cat", "rabbit"))
    together = first["there"] & second["there"]
    way = (first["world_from_agent"] - second["world_from_agent"])[together, :3, 3]
    assert (np.linalg.norm(way, axis=1) > 0.3).all()


def test_scores_of_several_animals_tell_swaps(two_drawn, tmp_path):
    build, truth = tmp_path / "build", two_drawn / "truth"
    index = open_recording(two_drawn / "recordings" / "session-1").index
    (build / "plan").mkdir(parents=True)
    video = Video("v001", "session-1", role="session", split="train", sha256=None)
    (build / "plan" / "videos.json").write_text(json.dumps([dataclasses.asdict(video)]))
    (build / "frames" / "v001").mkdir(parents=True)
    npz.save(build / "frames" / "v001" / "frames.npz", source_index=index)
    found = {}
    for names in (("cat", "rabbit"), ("rabbit", "cat")):
        for name, shown in zip(("cat", "rabbit"), names, strict=True):
            folder = build / "home_masks" / "v001" / name
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            masks = semi_real.read_truth(truth / shown / "session-1.npz", index)
            for row, mask in enumerate(masks):
                cv2.imwrite(str(folder / f"{row:06d}.png"), mask * np.uint8(255))
            npz.save(
                folder / "masks.npz", visible=masks.any((1, 2)), confidence=np.ones(len(masks), np.float32)
            )
        found[names] = semi_real.scores(build, truth)
    assert all(row["iou_mean"] == 1 and row["swaps"] == 0 for row in found["cat", "rabbit"].values())
    assert all(row["swaps"] > 0.1 for row in found["rabbit", "cat"].values())


@pytest.mark.slow
def test_masks_find_the_animal_and_only_it(drawn, tmp_path):
    sequence, out = drawn
    frames, flow, masks = (tmp_path / name for name in ("frames", "flow", "masks"))
    for folder in (frames, flow, masks):
        folder.mkdir()
    extracting.run(extracting.Inputs(out / "recordings" / "session-1"), FramesConfig(), frames)
    flowing.run(flowing.Inputs(frames), FlowConfig(), flow)
    segmenting.run(segmenting.Inputs(frames, flow), Config(), masks)
    found = Masks.open(masks)
    labels = np.stack([found[frame] for frame in range(len(sequence.numbers))])
    truth = semi_real.read_truth(out / "truth" / "session-1.npz", read_source_index(frames))
    metrics = semi_real.mask_metrics(labels, truth)
    assert metrics["frames_without"] >= 10 and metrics["frames_with"] >= 10
    assert metrics["false_frames"] == 0
    assert metrics["iou_mean"] > 0.5, "frames in which it is missed count as 0"
    assert metrics["precision"] > 0.85


def test_mask_metrics_have_known_values():
    truth = np.zeros((4, 10, 10), bool)
    truth[:2, 2:6, 2:6] = True
    labels = np.where(truth, 255, 0)
    labels[0, 5, 2:6] = 0
    labels[1, 0, 0] = 128
    labels[2, 0, :8] = 255
    found = semi_real.mask_metrics(labels, truth)
    assert found["false_frames"] == 0.5
    assert found["found_frames"] == 1.0
    assert found["precision"] == pytest.approx(28 / 36)
    assert found["iou_mean"] == pytest.approx((12 / 16 + 1) / 2)


def test_truth_is_found_by_frame_number(tmp_path):
    masks = np.zeros((3, 2, 8), bool)
    masks[1] = True
    npz.save(
        tmp_path / "t.npz",
        packed=np.packbits(masks, axis=-1),
        shape=np.array(masks.shape),
        source_index=np.array([0, 3, 6]),
    )
    assert semi_real.read_truth(tmp_path / "t.npz", np.array([3, 6])).any((1, 2)).tolist() == [True, False]


def test_phone_recordings_are_upright_with_the_pinhole_of_their_pictures(tmp_path):
    made = walk(12, quarter_turns=1)
    sequence = Sequence.open(made_formats.stray(tmp_path / "stray", made), first=2, step=2)
    assert sequence.numbers.tolist() == [2, 4, 6, 8, 10]
    assert sequence.size == sequence.color(0).shape[:2] == (64, 48)
    assert sequence.depth_size == (32, 24)
    np.testing.assert_allclose(sequence.intrinsics, walk(12).intrinsics, atol=1e-6)
    np.testing.assert_allclose(sequence.poses()[1], made.world_from_camera[4], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "frames", "code"), [("empty", {}, "CAP-003"), ("few", {"first": 20}, "CAP-007")]
)
def test_folders_without_frames_end_with_a_code(tmp_path, name, frames, code):
    folder = tmp_path / name
    folder.mkdir()
    if name == "few":
        made_formats.stray(folder, walk())
    with pytest.raises(InputError, match=code):
        Sequence.open(folder, **frames)


def test_depth_is_required(tmp_path):
    folder = made_formats.seven_scenes(tmp_path / "scene", walk(6))
    for path in folder.glob("*.depth.png"):
        path.unlink()
    with pytest.raises(InputError, match="CAP-006"):
        Sequence.open(folder)
