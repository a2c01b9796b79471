"""The depth camera of boxes in a moving camera's view is found with its errors; right recordings stay as they are."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from pipeline.calibration import estimation, given, recordings
from pipeline.calibration.depth_steps import PARAMETERS, StepProfiles, outlines
from pipeline.calibration.given import GivenCalibration
from pipeline.core.errors import InputError
from pipeline.geometry import cameras, rigid
from pipeline.recordings import extraction
from pipeline.recordings.recording import DepthCamera, Recording

SIZE, FOCAL, STEP_S, FRAMES, WALL_M = (120, 160), 150.0, 0.1, 60, 4.0
LENS = np.array([[FOCAL, 0, 80], [0, FOCAL, 60], [0, 0, 1.0]])


def _boxes(camera: np.ndarray, lens: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return gray values and depth of fronto-parallel boxes before a wall, as a camera (x, y, roll) sees them."""
    rng, (x, y, roll) = np.random.default_rng(seed), camera
    ray = cameras.ray_directions(lens, *SIZE)
    across = ray[..., 0] * np.cos(roll) - ray[..., 1] * np.sin(roll)
    down = ray[..., 0] * np.sin(roll) + ray[..., 1] * np.cos(roll)
    gray, depth = np.full(SIZE, 128.0), np.full(SIZE, WALL_M)
    for z in np.sort(rng.uniform(0.8, 3.0, 40))[::-1]:
        center, half = rng.uniform((-2, -1.2), (2, 1.2)), rng.uniform(0.05, 0.3, 2)
        inside = (np.abs(across * z + x - center[0]) < half[0]) & (np.abs(down * z + y - center[1]) < half[1])
        gray, depth = np.where(inside, rng.uniform(0, 255), gray), np.where(inside, z, depth)
    return gray, depth


def _recording(focal=1.0, shift_m=(0.0, 0.0), roll=0.0, delay_s=0.0, moving=1.0) -> Recording:
    """A recording whose depth camera and clock differ from the color camera's as said."""
    time_s = STEP_S * np.arange(FRAMES)

    def at(when):
        return moving * np.array([0.7 * np.sin(0.9 * when), 0.2 * np.sin(1.7 * when), 0.0])

    @cache
    def color(number):
        gray = _boxes(at(time_s[number]), LENS)[0]
        return np.repeat(gray[..., None], 3, axis=-1).astype(np.uint8)

    @cache
    def depth(number):
        lens = LENS * np.array([[focal, 1, 1], [1, focal, 1], [1, 1, 1]])
        camera = at(time_s[number] - delay_s) - np.array([*shift_m, 0.0]) + np.array([0, 0, roll])
        return _boxes(camera, lens)[1].astype(np.float32)

    return Recording(
        "made", "made", np.arange(FRAMES), time_s, np.tile(LENS, (FRAMES, 1, 1)), None, SIZE, SIZE, color, depth
    )  # fmt: skip


def _error(name: str, found: recordings.DepthEstimate) -> float:
    return float(found.error[PARAMETERS.index(name)])


@pytest.mark.parametrize(
    "true",
    [
        {"focal": 0.9, "shift_m": (0.03, 0.0)},
        {"focal": 1.05, "delay_s": 0.1},
        {"shift_m": (-0.05, 0.03), "delay_s": -0.2},
        {"delay_s": 0.13},
        {"roll": 0.03},
    ],
    ids=str,
)
def test_camera_and_clock_are_found_and_applied(true):
    recording = _recording(**true)
    calibrated = recordings.calibrate(recording)
    found, right = calibrated.estimate, _recording()
    assert found is not None
    true = {"focal": 1.0, "shift_m": (0.0, 0.0), "roll": 0.0, "delay_s": 0.0} | true
    assert found.focal == pytest.approx(true["focal"], abs=0.005 + 3 * _error("focal", found))
    for axis, name in enumerate("xy"):
        limit_m = 0.004 + 3 * _error(name, found)
        assert found.depth_from_color[axis, 3] == pytest.approx(true["shift_m"][axis], abs=limit_m)
    assert found.delay_s == pytest.approx(true["delay_s"], abs=0.005 + 3 * _error("delay", found))
    turn = rigid.vector_from_rotation(found.depth_from_color[:3, :3])
    np.testing.assert_allclose(np.abs(turn), [0, 0, true["roll"]], atol=0.005)
    stated = {"focal": 1.0, "shift_m": (0.0, 0.0), "roll": 0.0}
    differs = {"camera": stated.items() - true.items(), "delay": true["delay_s"]}
    assert calibrated.used == calibrated.clear == tuple(name for name, how in differs.items() if how)
    wrong = [
        np.mean([_off(each, right, number) for number in range(10, FRAMES - 10, 10)])
        for each in (recording, calibrated.recording)
    ]
    assert wrong[1] < 0.6 * wrong[0]


def _off(recording: Recording, right: Recording, number: int) -> float:
    """Return the share of depth that is off by more than 10 cm."""
    depth, true = (extraction.stored_depth(each, number, 5.0) for each in (recording, right))
    known = depth > 0
    return float((np.abs(depth - true)[known] > 0.1).mean())


def test_right_recording_stays_as_it_is():
    recording = _recording()
    calibrated = recordings.calibrate(recording)
    assert calibrated.recording is recording and calibrated.clear == calibrated.used == ()
    assert calibrated.estimate is not None and calibrated.estimate.shift < recordings.MIN_SHIFT / 2


def test_delay_is_unknown_to_a_camera_at_rest():
    calibrated = recordings.calibrate(_recording(delay_s=0.2, moving=0.0))
    assert calibrated.used == ()
    if calibrated.estimate is not None:
        assert not calibrated.estimate.delay_is_clear(STEP_S)


def test_without_outlines_nothing_is_estimated():
    recording = _recording()
    flat = replace(recording, read_depth=lambda number: np.full(SIZE, 2.0, np.float32))
    assert recordings.calibrate(flat).estimate is None


def test_what_is_given_is_kept():
    recording = _recording(focal=0.9, delay_s=0.2)
    stated = recordings.calibrate(recording, GivenCalibration(registered=True, delay_s=0.0))
    assert stated.clear == ("camera", "delay") and stated.used == () and stated.recording is recording
    lens = (0.9 * FOCAL, 0.9 * FOCAL, 80.0, 60.0)
    right = recordings.with_given(recording, GivenCalibration(depth_intrinsics=lens, delay_s=0.2))
    assert recordings.calibrate(right).clear == ()
    assert not right.read_depth(FRAMES - 1).any(), "there is no depth of that time"


def test_delay_of_a_given_coarse_camera_is_corrected():
    """Depth of half the resolution, whose outlines wander by two of its pixels, from a described camera."""
    focal, coarse, wander_px, size = 0.7, 2, 2, (60, 80)
    recording = _recording(focal=focal, shift_m=(0.05, 0.0), delay_s=0.1)

    def depth(number):
        read = cv2.resize(recording.read_depth(number), size[::-1], interpolation=cv2.INTER_NEAREST)
        bend = np.random.default_rng(number).standard_normal((15, 20, 2)).astype(np.float32)
        bend = wander_px * cv2.resize(bend, size[::-1])
        at = (
            np.stack(np.meshgrid(*(np.arange(side, dtype=np.float32) for side in size[::-1])), axis=-1) + bend
        )
        return cv2.remap(read, at, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)

    lens = LENS * np.array([[focal / coarse, 1, 1 / coarse], [1, focal / coarse, 1 / coarse], [1, 1, 1]])
    camera = DepthCamera(lens, rigid.make(np.eye(3), np.array([0.05, 0.0, 0.0])))
    coarser = replace(recording, depth_size=size, read_depth=depth, depth_camera=camera)
    calibrated = recordings.calibrate(coarser)
    assert calibrated.used == ("delay",) and calibrated.estimate is not None
    assert calibrated.estimate.delay_s == pytest.approx(0.1, abs=0.01)


def test_half_a_frame_of_a_delay_is_corrected_by_the_motion_of_the_picture():
    recording, right = _recording(delay_s=0.15), _recording()
    late = recordings.with_given(recording, GivenCalibration(delay_s=0.15))
    numbers = range(10, FRAMES - 10, 5)
    off = [[_off(each, right, number) for number in numbers] for each in (late, replace(late, moved=None))]
    assert np.mean(off[0]) < 0.5 * np.mean(off[1])


def test_confidence_moves_along_with_corrected_depth():
    plain = _recording(focal=0.95)
    stored = plain.read_depth(3)
    near, limit = stored < np.median(stored[stored > 0]), np.median(stored[stored > 0])
    levels = replace(plain, read_confidence=lambda _: np.where(near, 2, 1).astype(np.uint8))
    found = recordings.calibrate(levels)
    assert "camera" in found.used
    depth = extraction.stored_depth(found.recording, 3, 6.0)
    confidence = extraction.confidence_of(found.recording, 3, depth)
    assert np.mean(depth != stored) > 0.1, "depth moves"
    np.testing.assert_array_equal(confidence, np.select([depth == 0, depth < limit], [0, 2], 1))


@pytest.mark.parametrize("used", [(), recordings.PARTS])
def test_what_is_said_is_the_same_once_it_is_used(used):
    recording = _recording()
    found = recordings.DepthEstimate(0.9, rigid.make(np.eye(3), np.array([0.025, 0, 0])), 0.0, np.zeros(8))
    applied = recordings._changed(recording, found, used)
    keys = recordings.as_given(recordings.DepthCalibration(applied, found, recordings.PARTS, used))
    assert keys["depth_intrinsics"] == str([0.9 * FOCAL, 0.9 * FOCAL, 80.0, 60.0])


def test_what_fits_includes_the_delay_that_is_given():
    stated = GivenCalibration(registered=True, delay_s=0.1)
    recording = recordings.with_given(_recording(delay_s=0.3), stated)
    found = recordings.calibrate(recording, stated)
    assert found.clear == ("delay",) and found.used == () and found.estimate is not None
    keys = recordings.as_given(found)
    assert float(keys["delay_s"]) == pytest.approx(0.3, abs=0.02)


def test_estimate_is_said_in_the_keys_of_the_file(tmp_path):
    recording = _recording()
    found = recordings.DepthEstimate(0.9, rigid.make(np.eye(3), np.array([0.025, 0, 0])), 0.1, np.zeros(8))
    keys = recordings.as_given(recordings.DepthCalibration(recording, found, recordings.PARTS))
    (tmp_path / "a.depth.toml").write_text("\n".join(f"{key} = {value}" for key, value in keys.items()))
    said = given.read(tmp_path / "a.depth.toml")
    camera = given.described(recording, said).depth_camera
    assert isinstance(camera, DepthCamera) and said.delay_s == 0.1
    np.testing.assert_allclose(camera.intrinsics[[0, 1], [0, 1]], 0.9 * FOCAL)
    np.testing.assert_allclose(camera.depth_from_color, found.depth_from_color)
    assert "2.5 +- 0.0 cm left" in recordings.describe(found)
    assert "100 +- 0 ms late" in recordings.describe(found)


@pytest.mark.parametrize(
    "text",
    [
        "depth_intrinsics = [1.0, 2.0]",
        "registered = true\ndepth_intrinsics = [100.0, 100.0, 80.0, 60.0]",
        "delay_s = 5.0",
        "delay_s = nan",
    ],
)
def test_impossible_file_is_refused(tmp_path, text):
    (tmp_path / "a.depth.toml").write_text(text)
    with pytest.raises(InputError, match="CAP-004"):
        given.read(tmp_path / "a.depth.toml")


def test_impossible_camera_is_refused():
    far = GivenCalibration(depth_from_color=tuple(rigid.make(np.eye(3), np.array([25.0, 0, 0])).ravel()))
    with pytest.raises(InputError, match="CAP-004"):
        given.described(_recording(), far)


def test_outlines_face_the_farther_surface_across_a_shadow():
    depth = np.full(SIZE, 3.0, np.float32)
    depth[:, 60:100] = 1.0
    depth[:, 50:60] = 0.0
    pixel, near, normal = outlines(depth)
    assert (near == 1.0).all()
    assert set(np.round(pixel[:, 0])) == {60.0, 100.0}
    np.testing.assert_allclose(np.abs(normal[:, 0]), 1, atol=1e-3)
    assert ((pixel[:, 0] > 80) == (normal[:, 0] > 0)).all()


def test_standard_errors_are_those_of_repeated_samples():
    """Profiles with a peak at a known shift plus an error per point."""
    rng, truth, scores = np.random.default_rng(0), np.array([0.01, 0.005]), []
    columns = [PARAMETERS.index(name) for name in ("focal", "x")]
    for _ in range(30):
        derivative = np.zeros((2000, len(PARAMETERS)))
        derivative[:, columns] = rng.normal(size=(2000, 2)) * (100, 200)
        peak = derivative[:, columns] @ truth + rng.normal(size=2000)
        gradient = np.exp(-0.5 * ((np.arange(-12, 13) - peak[:, None]) / 1.5) ** 2)
        found = estimation.fit(StepProfiles(gradient, derivative, np.arange(2000) // 50), ("focal", "x"))
        assert found is not None
        scores.append((found.value[columns] - truth) / found.error[columns])
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1.0, abs=0.3)
