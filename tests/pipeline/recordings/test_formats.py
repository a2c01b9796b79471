"""Readers of all recording formats: the same walk is read back upright, metric and with poses."""

import codecs
import json
import struct
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
import trimesh
from av.video.reformatter import Colorspace

from pipeline.core.errors import InputError
from pipeline.data import images
from pipeline.geometry import rigid
from pipeline.recordings import extraction, stray_scanner, tum
from pipeline.recordings.formats import format_of, open_recording
from pipeline.recordings.movies import UNSPECIFIED, Movie
from pipeline.workflow.sources import recording_digest
from tests.pipeline.recordings import made_formats
from tests.stages.extract_frames.made_recordings import Made, walk, write_zip

LANDSCAPE = 3
"""quarter turns from upright to the landscape orientation in which iPhones store pictures"""
RATE_HZ = 15.0
"""of the synthetic walk, whose timestamps all formats can represent exactly"""
CASES = {
    "Stray Scanner": (made_formats.stray, LANDSCAPE),
    "Polycam raw data": (made_formats.polycam, LANDSCAPE),
    "NeRFCapture": (made_formats.nerfcapture, LANDSCAPE),
    "TUM RGB-D": (made_formats.tum, 0),
    "7-Scenes RGB-D": (made_formats.seven_scenes, 0),
    "video and depth": (made_formats.video_and_depth, 0),
}


def _understand(path):
    recording = open_recording(path)
    return recording, extraction.understand(recording, rate_hz=10.0, max_depth_m=6.0, max_side_px=640)


def _frames(recording, plan):
    return list(extraction.frames(recording, plan, max_depth_m=6.0))


@pytest.mark.parametrize("name", CASES)
def test_walk_is_read_back(tmp_path, name):
    write, turns = CASES[name]
    made, upright = walk(18, rate_hz=RATE_HZ, quarter_turns=turns), walk(18, rate_hz=RATE_HZ)
    path = write(tmp_path / "walkthrough", made)
    assert format_of(path).name == name
    recording, plan = _understand(path)
    assert plan.pose_check.verdict == "documented", plan.pose_check
    assert (turns + plan.quarter_turns) % 4 == 0
    assert plan.gravity_known == (turns == LANDSCAPE)
    np.testing.assert_allclose(plan.timestamp_s, made.timestamp_s[plan.chosen], atol=1e-3)
    np.testing.assert_allclose(plan.odometry_from_camera, upright.world_from_camera[plan.chosen], atol=1e-5)
    np.testing.assert_allclose(plan.intrinsics[0], upright.intrinsics, atol=1e-6)
    frames = _frames(recording, plan)
    for position in (0, 7, len(frames) - 1):
        frame, source = frames[position], plan.chosen[position]
        assert np.abs(frame.color.astype(int) - upright.color(source)).mean() < 4
        known = frame.depth[:: frame.depth.shape[0] // 32, :: frame.depth.shape[1] // 24]
        np.testing.assert_allclose(known, upright.depth(source), atol=1.1e-3)


@pytest.mark.parametrize("write", [made_formats.tum, made_formats.seven_scenes, made_formats.video_and_depth])
def test_poses_may_be_missing(tmp_path, write):
    _, plan = _understand(write(tmp_path / "a", walk(8), poses=False))
    assert plan.odometry_from_camera is None
    assert plan.pose_check.reason == "the recording has no device poses"
    assert len(plan.chosen) >= 5


TIMES, POSES = (np.arange(12) / RATE_HZ).tolist(), walk(12, rate_hz=RATE_HZ).poses().tolist()
MENDED = {
    "no intrinsics of frames": ({"perFrameIntrinsicCoeffs": []}, 12, None),
    "few intrinsics of frames": (
        {"perFrameIntrinsicCoeffs": [[51, 53, 25, 31]] * 9},
        12,
        "3 of 12 frames have no intrinsics",
    ),
    "no times": ({"frameTimestamps": []}, 12, None),
    "few times": ({"frameTimestamps": TIMES[:10]}, 10, "2 of 12 frames are left out"),
    "a time twice": (
        {"frameTimestamps": [*TIMES[:10], TIMES[9], TIMES[11]]},
        11,
        "1 of 12 frames are left out",
    ),
    "a time that is none": (
        {"frameTimestamps": [*TIMES[:10], None, TIMES[11]]},
        11,
        "1 of 12 frames are left out",
    ),
    "few poses": ({"poses": POSES[:10]}, 12, "2 of 12 frames have no device pose"),
    "another camera": ({"cameraType": 2}, 12, "camera type 2 is not known"),
}


@pytest.mark.parametrize("name", MENDED)
def test_missing_record3d_rows_drop_only_their_frames(tmp_path, name):
    change, frames, remark = MENDED[name]
    made = walk(12, rate_hz=RATE_HZ)
    made.metadata |= change
    recording = open_recording(made.write(tmp_path / "a.r3d"))
    assert len(recording.index) == len(recording.pose) == len(recording.intrinsics) == frames
    assert (np.diff(recording.timestamp_s) > 0).all()
    assert (
        [each.startswith(remark) for each in recording.remarks] == [True] if remark else not recording.remarks
    )


def test_missing_intrinsics_are_those_of_the_first_frame(tmp_path):
    made = walk(6)
    made.metadata["perFrameIntrinsicCoeffs"] = [
        [51, 53, 25, 31],
        [0, 0, 0, 0],
        [51, None, 25, 31],
        [51, 53, 25, 31],
    ]
    recording = open_recording(made.write(tmp_path / "a.r3d"))
    assert recording.intrinsics[:, 0, 0].tolist() == [51, 50, 50, 51, 50, 50]


def _windows(data: bytes) -> bytes:
    return codecs.BOM_UTF8 + data.replace(b"\n", b"\r\n")


def _powershell(data: bytes) -> bytes:
    return data.decode().encode("utf-16")


def _with_text_column(data: bytes) -> bytes:
    """With reordered columns and a text column."""
    rows = [row.split(b", ") for row in data.split(b"\n")]
    notes = [b"note", *[b"sofa"] * (len(rows) - 1)]
    return b"\n".join(b", ".join([*row[5:], note, *row[:5]]) for row, note in zip(rows, notes, strict=True))


@pytest.mark.parametrize(
    "saved", [_windows, _powershell, _with_text_column, lambda data: data.replace(b"time", b"Time")]
)
def test_odometry_times_are_read_from_reformatted_files(tmp_path, saved):
    """The timestamps of the video are four times too fast, so that only the column is correct."""
    path = made_formats.stray(tmp_path / "a", walk(8, rate_hz=RATE_HZ, quarter_turns=LANDSCAPE))
    (path / "odometry.csv").write_bytes(saved((path / "odometry.csv").read_bytes()))
    np.testing.assert_allclose(open_recording(path).timestamp_s, np.arange(8) / RATE_HZ, atol=1e-6)


@pytest.mark.parametrize("saved", [_windows, _powershell])
@pytest.mark.parametrize("write", [made_formats.tum, made_formats.video_and_depth, made_formats.seven_scenes])
def test_windows_text_files_are_read(tmp_path, write, saved):
    made = walk(6)
    path = write(tmp_path / "a", made)
    for file in path.glob("*.txt"):
        file.write_bytes(saved(file.read_bytes()))
    recording = open_recording(path)
    np.testing.assert_allclose(recording.intrinsics[0], made.intrinsics, atol=1e-6)
    np.testing.assert_allclose(np.abs(recording.pose), np.abs(made_formats.quaternion_poses(made)), atol=1e-6)


def test_windows_tum_lists_are_read(tmp_path):
    path = made_formats.tum(tmp_path / "a", walk(6))
    for name in ("rgb.txt", "depth.txt"):
        text = (path / name).read_text()
        (path / name).write_text(text.replace("/", "\\").replace(" rgb", ",rgb").replace(" depth", ",depth"))
    assert len(open_recording(path).index) == 6


def test_hidden_macos_files_are_ignored(tmp_path):
    path = made_formats.video_and_depth(tmp_path / "a", walk(6))
    before = recording_digest(path)
    for name in ("._clip.mov", ".DS_Store", "depth/._000001.png"):
        (path / name).write_bytes(b"\0\5\x16\7")
    assert len(open_recording(path).index) == 6
    assert recording_digest(path) == before


def test_depth_that_is_numbered_from_1_is_refused(tmp_path):
    """ffmpeg numbers pictures from 1; every frame would get the depth of its neighbor."""
    path = made_formats.video_and_depth(tmp_path / "a", walk(6))
    for number in range(5, -1, -1):
        (path / f"depth/{number:06d}.png").rename(path / f"depth/{number + 1:06d}.png")
    with pytest.raises(InputError, match=r"CAP-004(.|\n)*depth/ is numbered from 1 to 6(.|\n)*from 0"):
        open_recording(path)


@pytest.mark.parametrize("columns", [7, 9, 15])
def test_all_versions_of_stray_scanner_are_read(tmp_path, columns):
    made = walk(8, quarter_turns=LANDSCAPE)
    recording = open_recording(made_formats.stray(tmp_path / "a", made, columns))
    np.testing.assert_allclose(recording.intrinsics[5], made.intrinsics, atol=1e-6)
    np.testing.assert_allclose(np.abs(recording.pose), np.abs(made_formats.quaternion_poses(made)), atol=1e-9)
    if columns > 7:  # the oldest version has only the timestamps of the video
        np.testing.assert_allclose(recording.timestamp_s, made.timestamp_s, atol=1e-6)


def test_npy_depth_of_old_stray_scanners_is_read(tmp_path):
    path = made_formats.stray(tmp_path / "a", walk(6, quarter_turns=LANDSCAPE))
    before = [open_recording(path).read_depth(number) for number in range(6)]
    for picture in sorted((path / "depth").glob("*.png")):
        np.save(picture.with_suffix(".npy"), cv2.imread(str(picture), cv2.IMREAD_UNCHANGED))
        picture.unlink()
    recording = open_recording(path)
    np.testing.assert_array_equal([recording.read_depth(number) for number in range(6)], before)
    np.save(path / "depth/000000.npy", np.ones((4, 4)))
    with pytest.raises(InputError, match="CAP-008"):
        open_recording(path)


@pytest.mark.parametrize(("app", "folder"), [("stray", "confidence"), ("polycam", "keyframes/confidence")])
def test_missing_confidence_is_zero_for_that_frame_only(tmp_path, app, folder):
    path = getattr(made_formats, app)(tmp_path / "a", walk(8, quarter_turns=LANDSCAPE))
    sorted((path / folder).iterdir())[3].unlink()
    recording = open_recording(path)
    depth = np.ones(recording.depth_size, np.float32)
    confidence = [extraction.confidence_of(recording, int(number), depth) for number in recording.index]
    assert [np.unique(each).tolist() for each in confidence] == [[0] if i == 3 else [1] for i in range(8)]


def test_frames_without_depth_do_not_shift_others(tmp_path):
    made = walk(12, quarter_turns=LANDSCAPE)
    path = made_formats.stray(tmp_path / "a", made)
    (path / "depth" / "000004.png").unlink()
    recording = open_recording(path)
    assert recording.index.tolist() == [i for i in range(12) if i != 4]
    np.testing.assert_allclose(recording.timestamp_s, np.delete(made.timestamp_s, 4), atol=1e-6)
    assert np.abs(recording.read_color(9).astype(int) - made.color(9)).mean() < 4


def test_odometry_timestamps_are_used():
    text = (
        "timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy, "
        "distortion_center_x, distortion_center_y\n"
    )
    text += (
        "5.0, 000000, 0, 0, 0, 0, 0, 0, 1, 1597.8, 1597.8, 955.3, 717.7, , \n5.05, 000003, "
        "0, 0, 0, 0, 0, 0, 1, 1604.2, 1604.2, 955.5, 717.8, , "
    )
    rows = stray_scanner.read_odometry(text, "a")
    assert rows.frame.tolist() == [0, 3]
    assert rows.coefficients[:, 0].tolist() == [1597.8, 1604.2]


def test_a_pose_of_zeros_is_a_lost_one(tmp_path):
    made = walk(20, rate_hz=RATE_HZ)
    poses = made.poses().tolist()
    poses[7] = [0.0] * 7
    made.metadata["poses"] = poses
    _, plan = _understand(made.write(tmp_path / "a.r3d"))
    assert plan.odometry_from_camera is not None
    assert 7 not in plan.chosen.tolist()


def test_lost_tracking_drops_frames_or_all_poses(tmp_path):
    path = made_formats.seven_scenes(tmp_path / "a", walk(20))
    lost = sorted(path.glob("*.pose.txt"))[5:7]
    for file in lost:
        file.write_text("\n".join(["-1.#IND " * 4] * 4))
    _, plan = _understand(path)
    assert plan.odometry_from_camera is not None
    assert not {5, 6} & set(plan.chosen.tolist())
    for file in sorted(path.glob("*.pose.txt"))[:10]:
        file.unlink()
    _, plan = _understand(path)
    assert plan.odometry_from_camera is None
    assert "50 % of the frames have no device pose" in plan.pose_check.reason


def test_corrected_polycam_pictures_are_preferred_and_their_borders_have_no_depth(tmp_path):
    made = walk(6, quarter_turns=LANDSCAPE)
    drawn = Made.color
    dark = walk(6, quarter_turns=LANDSCAPE)
    path = made_formats.polycam(tmp_path / "a", made)

    class Bordered(Made):
        def color(self, frame):
            picture = drawn(self, frame).copy()
            picture[:, :16] = 0
            return picture

    made_formats.polycam(
        path, Bordered(dark.world_from_camera, dark.timestamp_s, quarter_turns=LANDSCAPE), corrected=True
    )
    depth = open_recording(path).read_depth(1_600_000_000)
    assert (depth[:, :7] == 0).all()
    assert (depth[:, 9:] > 0).all()


@pytest.mark.parametrize("ending", [".png", ".jpg"])
def test_stream_file_names_may_lack_the_extension(tmp_path, ending):
    path = made_formats.nerfcapture(tmp_path / "a", walk(6))
    table = json.loads((path / "transforms.json").read_text())
    for frame in table["frames"]:
        stored = path / frame["file_path"]
        stored.rename(stored.with_suffix(ending))
        frame["file_path"] = frame["file_path"].removesuffix(".png")
    (path / "transforms.json").write_text(json.dumps(table))
    recording = open_recording(path)
    assert len(recording.index) == 6
    assert recording.read_color(5) == (path / f"rgb/5{ending}").read_bytes()


@pytest.mark.parametrize("per_meter", [1000, 5000, 10_000])
def test_poses_distinguish_millimeters_from_dataset_units(tmp_path, per_meter):
    made = walk(18, rate_hz=RATE_HZ)
    recording = open_recording(made_formats.tum(tmp_path / "a", made, per_meter=per_meter))
    np.testing.assert_allclose(recording.read_depth(3), made.depth(3), atol=1e-3)
    assert any(f"{per_meter} units per meter" in remark for remark in recording.remarks)


@pytest.mark.parametrize(("per_meter", "named"), [(100, "times 10 "), (1000, ""), (200, "times 5 ")])
def test_poses_name_the_unit_in_which_depth_would_agree(tmp_path, per_meter, named):
    made = walk(18, rate_hz=RATE_HZ)
    path = made_formats.video_and_depth(tmp_path / "a", made)
    for number in range(18):
        depth = made_formats.png(made_formats.millimeters(made.depth(number), per_meter))
        (path / f"depth/{number:06d}.png").write_bytes(depth)
    _, plan = _understand(path)
    assert (plan.odometry_from_camera is None) == bool(named)
    assert f"depth {named}would agree with them" in plan.pose_check.reason or not named


def test_depth_scale_file_gives_the_depth_unit(tmp_path):
    made = walk(6)
    path = made_formats.tum(tmp_path / "a", made, poses=False, per_meter=256)
    (path / "depth_scale.txt").write_text("# units per meter\n256\n")
    recording = open_recording(path)
    np.testing.assert_allclose(recording.read_depth(3), made.depth(3), atol=3e-3)
    assert not recording.remarks
    for impossible in ("0", "inf", "1000 1000", "millimeters"):
        (path / "depth_scale.txt").write_text(impossible)
        with pytest.raises(InputError, match="CAP-004"):
            open_recording(path)


@pytest.mark.parametrize(
    ("per_second", "unit"), [(1, ""), (1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")]
)
@pytest.mark.parametrize("rate_hz", [0.2, 15.0, 100.0])
def test_time_stamps_in_other_units_are_read(tmp_path, per_second, unit, rate_hz):
    made = walk(12, rate_hz)
    path = made_formats.tum(tmp_path / "a", made)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        cells = [line.split(" ", 1) for line in (path / name).read_text().splitlines() if line[0] != "#"]
        lines = [f"{float(time) * per_second:.6f} {rest}" for time, rest in cells]
        (path / name).write_text("\n".join(lines))
    recording = open_recording(path)
    np.testing.assert_allclose(recording.timestamp_s, made.timestamp_s, atol=1e-5)
    assert np.isfinite(recording.pose).all()
    assert any(f"seem to be {unit}" in each for each in recording.remarks) == bool(unit)


def test_listed_files_that_are_absent_are_named(tmp_path):
    path = made_formats.tum(tmp_path / "a", walk(6))
    (path / "depth").rename(tmp_path / "elsewhere")
    first = (path / "depth.txt").read_text().split()[-11]
    with pytest.raises(InputError, match=f"CAP-007.*6 of 12 listed files do not exist, e.g. {first}"):
        open_recording(path)
    (path / "rgb").rename(tmp_path / "rgb")
    with pytest.raises(InputError, match="CAP-007.*12 of 12 listed files do not exist, e.g. rgb/"):
        open_recording(path)


def test_streams_are_associated_by_time():
    times = np.array([0.0, 0.1, 0.2, 5.0])
    assert tum.partners(times, np.array([0.015, 0.19])).tolist() == [0, -1, 1, -1]


def test_damaged_frames_of_a_video_are_reported(tmp_path):
    made = walk(40)
    made_formats.write_movie(tmp_path / "a.mp4", [made.color(i) for i in range(40)], rate=15)
    data = bytearray((tmp_path / "a.mp4").read_bytes())
    start = data.find(b"mdat")
    middle = start + (len(data) - start) // 2
    data[middle - 300 : middle + 300] = bytes(600)
    (tmp_path / "a.mp4").write_bytes(data)
    movie = Movie(tmp_path / "a.mp4")
    assert len(movie) == 40
    right = [
        picture is not None and np.abs(picture.astype(int) - made.color(i)).mean() < 4
        for i in range(40)
        for picture in [movie.read(i)]
    ]
    assert right[0] and right[39]
    assert 20 < sum(right) < 40


def test_video_frames_are_read_in_any_order(tmp_path):
    made = walk(30)
    made_formats.write_movie(tmp_path / "a.mp4", [made.color(i) for i in range(30)])
    movie = Movie(tmp_path / "a.mp4")
    for number in (3, 4, 20, 2, 29, 0):
        assert np.abs(movie.read(number).astype(int) - made.color(number)).mean() < 0.6, number


def test_pictures_stored_after_a_later_key_frame_are_decoded(tmp_path):
    """HEVC of phones: decoding from that key frame alone would drop them."""
    open_groups = "log-level=none:keyint=10:min-keyint=10:bframes=4:open-gop=1:scenecut=0"
    pictures = [np.full((64, 64, 3), 5 * i, np.uint8) for i in range(40)]
    made_formats.write_movie(
        tmp_path / "a.mov", pictures, codec="libx265", options={"x265-params": open_groups}
    )
    for number in range(39, -1, -1):  # backwards: each requires a new seek
        found = Movie(tmp_path / "a.mov").read(number)
        assert found is not None and abs(float(found.mean()) - 5 * number) < 3, number


BT2020_FROM_BT709 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])
MASTERED = "G(8500,39850)B(6550,2300)R(35400,14600)WP(15635,16450)L(10000000,1)"
"""mastering display of 1000 cd/m2, as written by Samsung phones"""


def _hdr(srgb, curve):
    """Encode a picture with a white of 203 cd/m2 (ITU-R BT.2408) by the transfer functions of ITU-R BT.2100,
    0..1.
    """
    shown = 0.203 * images.linear_from_srgb(srgb / 255) @ BT2020_FROM_BT709.T  # of 1000 cd/m2
    if curve == "smpte2084":
        power = (shown / 10) ** 0.1593017578125
        return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375
    light = shown * (shown @ [0.2627, 0.6780, 0.0593])[..., None] ** (1 / 1.2 - 1)
    dark, bright = np.sqrt(3 * light), np.log(np.maximum(12 * light - 0.28466892, 0.1))
    return np.where(light < 1 / 12, dark, 0.17883277 * bright + 0.55991073)


@pytest.mark.slow  # color look-up tables, once per video
@pytest.mark.parametrize("curve", ["arib-std-b67", "smpte2084"])
def test_hdr_is_converted_to_standard_colors(tmp_path, curve):
    """iPhones write HLG, Samsung phones PQ, which look washed out without conversion. Tolerance: 8 levels,
    since 8-bit HDR is coarse.
    """
    color = np.array([[40, 40, 40], [128, 128, 128], [235, 235, 235], [200, 40, 40], [224, 172, 140]])
    picture = np.repeat(np.repeat(color[None], 32, axis=0), 32, axis=1)
    stored = np.rint(255 * _hdr(picture, curve)).astype(np.uint8)
    tags = f"colorprim=bt2020:transfer={curve}:colormatrix=smpte170m:hdr10=1:master-display={MASTERED}"
    encoder = {"codec": "libx265", "options": {"x265-params": f"log-level=none:crf=4:{tags}"}}
    shape = {"aspect": Fraction(161, 160), "pixels": "yuv420p"}  # of odd width
    made_formats.write_movie(tmp_path / "a.mov", [stored] * 3, **encoder, **shape)
    found = Movie(tmp_path / "a.mov", square_pixels=True).read(1)
    assert found.shape == (32, 161, 3)
    np.testing.assert_allclose(found[16, 16::32], color, atol=8)


@pytest.mark.parametrize(("rows", "matrix"), [(720, Colorspace.ITU709), (480, Colorspace.SMPTE170M)])
def test_default_color_matrix_depends_on_the_video_size(tmp_path, rows, matrix):
    color = np.array([200, 40, 40], np.uint8)
    made = av.VideoFrame.from_ndarray(np.tile(color, (rows, rows, 1)), format="rgb24")
    with av.open(str(tmp_path / "a.mp4"), "w") as written:
        track = written.add_stream("libx264", rate=10)
        track.width, track.height, track.pix_fmt, track.options = rows, rows, "yuv420p", {"crf": "4"}
        for time in range(3):
            frame = made.reformat(format="yuv420p", dst_colorspace=matrix)
            frame.colorspace, frame.pts = UNSPECIFIED, time
            written.mux(track.encode(frame))
        written.mux(track.encode())
    np.testing.assert_allclose(Movie(tmp_path / "a.mp4").read(1)[9, 9], color, atol=3)


def _remux(path, source, *, still=False, **options):
    """Copy a video to another file, after a track with a single still picture, as in live photos."""
    with av.open(str(source)) as read, av.open(str(path), "w", options=options) as written:
        first = written.add_stream("mjpeg", rate=1) if still else None
        track = written.add_stream_from_template(read.streams.video[0])
        if first is not None:
            first.width, first.height, first.pix_fmt = 128, 96, "yuvj420p"
            written.mux(first.encode(av.VideoFrame(128, 96, "yuvj420p")))
            written.mux(first.encode())
        for packet in read.demux(video=0):
            if packet.dts is not None:
                packet.stream = track
                written.mux(packet)


def test_still_picture_track_is_ignored(tmp_path):
    made = walk(12)
    made_formats.write_movie(tmp_path / "a.mp4", [made.color(i) for i in range(12)])
    _remux(tmp_path / "live.mov", tmp_path / "a.mp4", still=True)
    movie = Movie(tmp_path / "live.mov")
    assert len(movie) == 12
    assert np.abs(movie.read(5).astype(int) - made.color(5)).mean() < 0.6


def test_truncated_video_lacks_its_last_pictures(tmp_path):
    made = walk(40)
    made_formats.write_movie(tmp_path / "a.mp4", [made.color(i) for i in range(40)])
    _remux(tmp_path / "b.mp4", tmp_path / "a.mp4", movflags="faststart")
    data = (tmp_path / "b.mp4").read_bytes()
    (tmp_path / "b.mp4").write_bytes(data[: len(data) * 2 // 3])
    movie = Movie(tmp_path / "b.mp4")
    assert len(movie) == 40
    lost = [movie.read(i) is None for i in range(40)]
    assert lost == sorted(lost) and 5 < sum(lost) < 35


@pytest.mark.parametrize("turns", range(4))
def test_mirrored_display_matrix_is_reduced_to_a_rotation(tmp_path, turns):
    """Selfie apps may ask players to mirror the picture."""
    made_formats.write_movie(tmp_path / "a.mp4", [walk(3).color(i) for i in range(3)])
    _turn_track(tmp_path / "a.mp4", turns, mirrored=True)
    assert Movie(tmp_path / "a.mp4").quarter_turns == turns


@pytest.mark.parametrize(("captured", "times_slower"), [("240.0", 8), ("60.0", 1), ("1", 1 / 30), ("?", 1)])
def test_android_slow_motion_has_real_time_timestamps(tmp_path, captured, times_slower):
    """Ordinary 60 Hz video that drops to 30 Hz in dim light keeps its timestamps."""
    path = tmp_path / "a.mp4"
    tags = {"com.android.capture.fps": captured}
    made_formats.write_movie(path, [walk(6).color(i) for i in range(6)], rate=30, tags=tags)
    np.testing.assert_allclose(Movie(path).timestamp_s, np.arange(6) / 30 / times_slower, atol=1e-3)


@pytest.mark.parametrize(("aspect", "width"), [(Fraction(4, 3), 64), (Fraction(1), 48), (Fraction(90), 48)])
def test_video_without_depth_has_square_pixels(tmp_path, aspect, width):
    """A video without depth is calibrated with one focal length; with depth its intrinsics are kept."""
    path, made = tmp_path / "a.mp4", walk(6)
    made_formats.write_movie(path, [made.color(i) for i in range(6)], aspect=aspect)
    recording = open_recording(path)
    assert recording.color_size == recording.read_color(0).shape[:2] == (64, width)
    assert Movie(path).size == (64, 48)


def _no_depth(path, made):
    made_formats.write_movie(path.with_suffix(".mp4"), [made.color(i) for i in range(6)])
    return path.with_suffix(".mp4")


def _no_intrinsics(path, made):
    made_formats.video_and_depth(path, made)
    (path / "intrinsics.txt").unlink()
    return path


def _millimeters_as_meters(path, made):
    made_formats.video_and_depth(path, made)
    for number in range(6):
        (path / f"depth/{number:06d}.png").unlink(missing_ok=True)
        images.write_depth(path / f"depth/{number:06d}.exr", 100 * made.depth(number))
    return path


def _video_of_another_shape(path, made):
    made_formats.video_and_depth(path, made)
    made_formats.write_movie(path / "clip.mov", [made.color(i)[:48] for i in range(6)])
    return path


def _intrinsics_of_another_size(path, made):
    made_formats.video_and_depth(path, made)
    (path / "intrinsics.txt").write_text("3000 3000 1920 1080")
    return path


def _intrinsics_of_half_the_size(path, made):
    made_formats.video_and_depth(path, made)
    fx, fy, cx, cy = made.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]] / 2
    (path / "intrinsics.txt").write_text(f"{fx} {fy} {cx} {cy}")
    return path


def _constant_rows(path, made):
    made_formats.stray(path, made)
    for file in (path / "depth").iterdir():
        file.write_bytes(
            made_formats.png(np.repeat(np.arange(32, dtype=np.uint16)[:, None] + 900, 24, axis=1))
        )
    return path


def _new_odometry(path, made):
    made_formats.stray(path, made)
    (path / "odometry.csv").write_text("time, pose\n0.0, 1\n")
    return path


def _new_polycam(path, made):
    made_formats.polycam(path, made)
    for file in (path / "keyframes" / "cameras").iterdir():
        file.write_text(json.dumps({"transform": np.eye(4).tolist()}))
    return path


def _cut_video(path, made):
    made_formats.stray(path, made)
    (path / "rgb.mp4").write_bytes((path / "rgb.mp4").read_bytes()[:900])
    return path


def _other_depth_size(path, made):
    made_formats.seven_scenes(path, made)
    sorted(path.glob("*.depth.png"))[0].write_bytes(made_formats.png(np.zeros((5, 6), np.uint8)))
    return path


def _unmatched(path, made):
    made_formats.tum(path, made)
    (path / "depth.txt").write_text("1.0 depth/a.png\n")
    return path


def _zip_of_record3d(path, made):
    return made.write(path.with_suffix(".r3d")).rename(path.with_suffix(".zip"))


def _zipped(path, made):
    write_zip(path.with_suffix(".zip"), {"a/rgb.mp4": b"", "a/odometry.csv": b""})
    return path.with_suffix(".zip")


def _no_depth_anywhere(path, made):
    made_formats.video_and_depth(path, made)
    for file in (path / "depth").iterdir():
        file.write_bytes(made_formats.png(np.zeros((32, 24), np.uint16)))
    return path


def _upper_case(path, made):
    made_formats.stray(path, made)
    (path / "rgb.mp4").rename(path / "RGB.MP4")
    return path


def _depth_from_1(path, made):
    made_formats.stray(path, made)
    for file in sorted((path / "depth").iterdir(), reverse=True):
        file.rename(file.with_stem(f"{int(file.stem) + 1:06d}"))
    return path


def _odometry_from_1(path, made):
    made_formats.stray(path, made)
    head, *rows = (path / "odometry.csv").read_text().splitlines()
    column = [each.strip() for each in head.split(",")].index("frame")
    cells = [row.split(",") for row in rows]
    for number, row in enumerate(cells, start=1):
        row[column] = f"{number:06d}"
    (path / "odometry.csv").write_text("\n".join([head, *map(",".join, cells)]))
    return path


FAULTS = {
    "CAP-001": _cut_video,
    "CAP-003": lambda path, made: path,
    "CAP-003 ": _zipped,
    "CAP-003  ": _zip_of_record3d,
    "CAP-004": _new_odometry,
    "CAP-004 ": _new_polycam,
    "CAP-004    ": _upper_case,
    "CAP-004     ": _depth_from_1,
    "CAP-004      ": _odometry_from_1,
    "CAP-006": _no_depth,
    "CAP-007": _unmatched,
    "CAP-007 ": _no_depth_anywhere,
    "CAP-008": _other_depth_size,
    "CAP-004  ": _intrinsics_of_another_size,
    "CAP-004   ": _intrinsics_of_half_the_size,
    "CAP-008 ": _millimeters_as_meters,
    "CAP-008  ": _video_of_another_shape,
    "CAP-009": _constant_rows,
    "CAP-010": lambda path, made: made_formats.nerfcapture_zip(path.with_suffix(".zip"), made),
    "CAP-010 ": lambda path, made: made_formats.nerfcapture(path, made, reach_m=1.0),
    "CAP-011": _no_intrinsics,
}


@pytest.mark.parametrize("code", FAULTS)
def test_unusable_recordings_are_refused_with_a_remedy(tmp_path, code):
    path = FAULTS[code](tmp_path / "a", walk(6))
    with pytest.raises(InputError) as refused:
        _understand(path)
    assert refused.value.code == code.strip()
    assert refused.value.remedy
    assert (refused.value.remedy == "rename it to .r3d") == (FAULTS[code] is _zip_of_record3d)


def test_folders_inside_of_depth_are_left_alone(tmp_path):
    made = walk(6)
    path = made_formats.video_and_depth(tmp_path / "a", made)
    other = made_formats.png(made_formats.millimeters(np.full_like(made.depth(0), 0.5)))
    made_formats.put(path / "depth" / "raw", {f"{frame:06d}.png": other for frame in range(6)})
    np.testing.assert_allclose(open_recording(path).read_depth(2), made.depth(2), atol=1e-3)


@pytest.mark.parametrize(
    ("color", "depth"), [((1920, 1440), (256, 192)), ((1080, 1920), (144, 256)), ((768, 1366), (27, 48))]
)
def test_aspect_ratios_may_differ_by_rounding(color, depth):
    extraction._refuse_other_shape(color, depth, "a")
    with pytest.raises(InputError, match=f"CAP-008.*depth of {depth[0]} x {depth[1]}"):
        extraction._refuse_other_shape(color, depth[::-1], "a")


@pytest.mark.parametrize("turns", range(4))
def test_display_matrix_makes_a_video_upright(tmp_path, turns):
    """Phones store landscape pictures and a display matrix in the track header."""
    stored, upright = walk(8, quarter_turns=-turns % 4), walk(8)
    path = made_formats.video_and_depth(tmp_path / "a", stored)
    _turn_track(path / "clip.mov", turns)
    recording, plan = _understand(path)
    assert recording.quarter_turns == plan.quarter_turns == turns
    np.testing.assert_allclose(plan.intrinsics[0], upright.intrinsics, atol=1e-6)
    np.testing.assert_allclose(
        plan.odometry_from_camera[0], upright.world_from_camera[plan.chosen[0]], atol=1e-5
    )
    frame = _frames(recording, plan)[2]
    assert np.abs(frame.color.astype(int) - upright.color(plan.chosen[2])).mean() < 4


def _turn_track(path, turns, *, mirrored=False):
    """Write clockwise quarter turns into the display matrix (16.16 fixed point) of the track header."""
    cosine, sine = [(1, 0), (0, 1), (-1, 0), (0, -1)][turns]
    right = -1 if mirrored else 1
    data = bytearray(path.read_bytes())
    at = data.find(b"tkhd") + 4 + 40
    for place, value in ((0, right * cosine), (1, right * sine), (3, -sine), (4, cosine)):
        struct.pack_into(">i", data, at + 4 * place, value << 16)
    path.write_bytes(data)


def test_frames_before_the_edit_list_are_dropped(tmp_path):
    """A trimmed video keeps the pictures from the last key frame on, and an edit list with the start."""
    made = walk(20)
    path = tmp_path / "a.mp4"
    made_formats.write_movie(path, [made.color(i) for i in range(20)], rate=15)
    data = bytearray(path.read_bytes())
    units_per_s = struct.unpack_from(">I", data, data.find(b"mdhd") + 16)[0]
    struct.pack_into(">i", data, data.find(b"elst") + 16, 5 * units_per_s // 15)
    path.write_bytes(data)
    movie = Movie(path)
    assert len(movie) == 15
    assert all(np.abs(movie.read(i).astype(int) - made.color(i + 5)).mean() < 4 for i in range(15))


def test_polycam_mesh_is_in_the_frame_of_its_cameras(tmp_path):
    box = trimesh.creation.box((4.0, 2.5, 5.0), rigid.make(np.eye(3), np.array([2.0, 1.25, 2.5])))
    folder = made_formats.polycam(tmp_path / "a", walk(12))
    assert open_recording(folder).read_mesh is None
    turn = rigid.make(rigid.rotation_from_vector(np.array([0.0, 0.7, 0.0])), np.array([0.3, -1.0, 0.2]))
    made_formats.polycam_mesh(folder, box, turn)
    mesh = open_recording(folder).read_mesh()
    np.testing.assert_allclose(np.sort(mesh.vertices, axis=0), np.sort(box.vertices, axis=0), atol=1e-5)
    (folder / "raw.glb").write_bytes((folder / "raw.glb").read_bytes()[:100])
    with pytest.raises(InputError, match="CAP-001"):
        open_recording(folder).read_mesh()
    (folder / "mesh_info.json").write_text("{}")
    with pytest.raises(InputError, match="CAP-004"):
        open_recording(folder).read_mesh()


@pytest.mark.parametrize(("up_deg", "known"), [(0, True), (10, True), (90, False), (180, False)])
def test_up_direction_that_contradicts_the_floor_is_ignored(tmp_path, monkeypatch, up_deg, known):
    """An app may export z up in a format with y up."""
    up = np.array([0, np.cos(np.radians(up_deg)), np.sin(np.radians(up_deg))])
    monkeypatch.setattr(extraction.upright, "up_from_room", lambda *_: up)
    recording, plan = _understand(walk(60).write(tmp_path / "a.r3d"))
    assert plan.gravity_known == known
    assert ("gravity is not used" in extraction.summary(recording, plan)) == (not known)
