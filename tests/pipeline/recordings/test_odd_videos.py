"""Recordings in odd but real forms: cut off, wide colors, missing files, varying times."""

import json
import zipfile
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.video.reformatter import ColorPrimaries, ColorTrc

from pipeline.core.errors import InputError
from pipeline.data import images
from pipeline.recordings.formats import open_recording
from pipeline.recordings.movies import Movie
from tests.pipeline.recordings import made_formats
from tests.stages.extract_frames.made_recordings import walk


def _cut(path, share):
    data = path.read_bytes()
    cut = path.with_stem("cut")
    cut.write_bytes(data[: int(share * len(data))])
    return cut


@pytest.mark.parametrize(("ending", "codec"), [("mkv", "libx264"), ("webm", "libvpx-vp9")])
def test_a_matroska_that_was_cut_off_lacks_what_its_header_declares(tmp_path, ending, codec):
    """Its index stood at the end: the file reads like a shorter recording that is complete."""
    made, path = walk(90), tmp_path / f"whole.{ending}"
    options = {} if ending == "webm" else None
    made_formats.write_movie(path, [made.color(i) for i in range(90)], rate=30, codec=codec, options=options)
    whole = open_recording(path)
    assert (len(whole.index), whole.incomplete, whole.remarks) == (90, 0.0, ())
    recording = open_recording(_cut(path, 0.7))
    assert recording.listed == 90
    assert 0.2 < recording.incomplete < 0.5
    assert len(recording.timestamp_s) == len(recording.index) < 75
    assert "of 3.0 s" in recording.remarks[0] and "copy it again" in recording.remarks[0]
    with pytest.raises(InputError, match=r"CAP-001.*the pictures end after .* of 3\.0 s"):
        open_recording(_cut(path, 0.3))


def test_a_matroska_that_declares_no_duration_is_complete(tmp_path):
    """As a browser records; FFmpeg estimates one from the rate of uncompressed sound, far too long."""
    made = walk(360)
    with av.open(str(tmp_path / "live.mkv"), "w", options={"live": "1"}) as written:
        track = written.add_stream("mjpeg", rate=30)
        track.height, track.width, track.pix_fmt, track.bit_rate = 64, 48, "yuvj420p", 2_000_000
        sound = written.add_stream("pcm_s16le", rate=48_000)
        for number in range(360):
            frame = av.VideoFrame.from_ndarray(made.color(number), format="rgb24")
            frame.pts, frame.time_base = number, Fraction(1, 30)
            written.mux(track.encode(frame))
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 1600), np.int16), format="s16", layout="mono")
            silence.rate, silence.pts = 48_000, 1600 * number
            written.mux(sound.encode(silence))
    with av.open(str(tmp_path / "live.mkv")) as read:
        assert read.duration > 12.6e6, "microseconds"
    assert open_recording(tmp_path / "live.mkv").incomplete == 0


SRGB_FROM_P3 = np.array([[1.2249, -0.2247, 0.0], [-0.0420, 1.0419, 0.0], [-0.0197, -0.0786, 1.0979]])
COLORS = np.array(
    [[40, 40, 40], [128, 128, 128], [235, 235, 235], [200, 40, 40], [60, 160, 60], [30, 60, 200]]
)


def _stripes(color):
    return np.repeat(np.repeat(color[None].astype(np.uint8), 32, axis=0), 32, axis=1)


@pytest.mark.slow  # tables of colors
@pytest.mark.parametrize("curve", [ColorTrc.BT709, ColorTrc.IEC61966_2_1])
def test_display_p3_becomes_srgb(tmp_path, curve):
    """Its red is redder: a red animal would fade, and differ from the one of another phone."""
    light = images.linear_from_srgb(COLORS / 255) @ np.linalg.inv(SRGB_FROM_P3).T
    stored = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    assert np.abs(255 * stored - COLORS).max() > 25
    with av.open(str(tmp_path / "a.mov"), "w") as written:
        track = written.add_stream("libx264", rate=30, options={"crf": "2"})
        track.height, track.width, track.pix_fmt = 32, 192, "yuv444p"
        track.codec_context.color_primaries, track.codec_context.color_trc = ColorPrimaries.SMPTE432, curve
        for _ in range(3):
            frame = av.VideoFrame.from_ndarray(_stripes(np.rint(255 * stored)), format="rgb24")
            frame.color_primaries, frame.color_trc = ColorPrimaries.SMPTE432, curve
            written.mux(track.encode(frame))
        written.mux(track.encode())
    np.testing.assert_allclose(Movie(tmp_path / "a.mov").read(1)[16, 16::32], COLORS, atol=6)


def test_fields_of_interlaced_video_are_not_mixed(tmp_path):
    """Its even rows were taken before its odd ones: a moving edge becomes a comb."""
    picture = np.full((64, 64, 3), 40, np.uint8)
    picture[::2, :20], picture[1::2, :30] = 220, 220
    options = {"crf": "4", "flags": "+ildct+ilme", "x264-params": "tff=1"}
    made_formats.write_movie(tmp_path / "a.mp4", [picture] * 4, options=options)
    found = Movie(tmp_path / "a.mp4").read(2).astype(int)
    assert found.shape == picture.shape
    assert np.abs(found[:, 24].mean() - 40) < 6
    assert np.abs(np.diff(found[:, :, 0], axis=0)).max() < 12


def test_times_vary_and_may_begin_anywhere(tmp_path):
    times_ms = 10_000 + np.cumsum(np.random.default_rng(0).integers(8, 60, 40))
    for ending in ("mp4", "mkv"):
        with av.open(str(tmp_path / f"Grüße an 🐈 1.{ending.upper()}"), "w") as written:
            track = written.add_stream("libx264", rate=30)
            track.height, track.width, track.pix_fmt = 64, 48, "yuv420p"
            track.codec_context.time_base = Fraction(1, 1000)
            for number, time in enumerate(times_ms.tolist()):
                frame = av.VideoFrame.from_ndarray(walk(40).color(number), format="rgb24")
                frame.pts, frame.time_base = time, Fraction(1, 1000)
                written.mux(track.encode(frame))
            written.mux(track.encode())
        recording = open_recording(tmp_path / f"Grüße an 🐈 1.{ending.upper()}")
        np.testing.assert_allclose(recording.timestamp_s, (times_ms - times_ms[0]) / 1000, atol=1e-3)


@pytest.mark.parametrize("missing", ["rgbd/{}.jpg", "rgbd/{}.depth"])
def test_record3d_without_its_last_frames(tmp_path, missing):
    made = walk(60)
    made.members |= {missing.format(number): None for number in range(45, 60)}
    recording = open_recording(made.write(tmp_path / "a.r3d"))
    assert (len(recording.index), recording.listed, recording.incomplete) == (45, 60, 0.25)


FOLDERS = {
    "stray": "depth/*",
    "tum": "depth/*",
    "seven_scenes": "*.depth.png",
    "polycam": "keyframes/depth/*",
    "nerfcapture": "depth/*",
    "video_and_depth": "depth/*",
}


@pytest.mark.parametrize("app", FOLDERS)
def test_a_folder_without_its_last_depth(tmp_path, app):
    path = getattr(made_formats, app)(tmp_path / "a", walk(40, rate_hz=15.0))
    assert open_recording(path).incomplete == 0
    for file in sorted(path.glob(FOLDERS[app]), key=lambda file: (len(file.name), file.name))[30:]:
        file.unlink()
    recording = open_recording(path)
    assert len(recording.index) == 30
    assert recording.incomplete == 0.25


def test_rows_that_stray_scanner_cut_or_timed_twice_cost_no_more_than_themselves(tmp_path):
    path = made_formats.stray(tmp_path / "a", walk(40, rate_hz=15.0))
    rows = (path / "odometry.csv").read_text().split("\n")
    twice = ", ".join([rows[10].split(", ")[0], *rows[11].split(", ")[1:]])
    (path / "odometry.csv").write_text("\n".join([*rows[:11], twice, *rows[12:-1], rows[-1][:60]]))
    recording = open_recording(path)
    assert recording.index.tolist() == [i for i in range(39) if i != 10]
    assert recording.incomplete == 0.05
    (path / "odometry.csv").write_text("\n".join([rows[0], *rows[:0:-1]]))
    with pytest.raises(InputError, match="CAP-004.*the times must increase"):
        open_recording(path)


def _with_times(folder: Path, app: str, times_s: np.ndarray) -> Path:
    """Write a walk with other times than its own."""
    made = walk(len(times_s), rate_hz=15.0)
    if app == "record3d":
        made.metadata["frameTimestamps"] = times_s.tolist()
        return made.write(folder / "a.r3d")
    if app == "nerfcapture":
        path = made_formats.nerfcapture(folder / "a", made)
        table = json.loads((path / "transforms.json").read_text())
        for frame, time_s in zip(reversed(table["frames"]), times_s.tolist(), strict=True):
            frame["timestamp"] = time_s
        (path / "transforms.json").write_text(json.dumps(table))
        return path
    path = made_formats.stray(folder / "a", made)
    head, *rows = (row.split(", ") for row in (path / "odometry.csv").read_text().split("\n"))
    lines = [[repr(time_s), *row[1:]] for time_s, row in zip(times_s.tolist(), rows, strict=True)]
    (path / "odometry.csv").write_text("\n".join(", ".join(row) for row in [head, *lines]))
    return path


@pytest.mark.parametrize("app", ["record3d", "stray", "nerfcapture"])
@pytest.mark.parametrize(("row", "off_s"), [(3, 1000.0), (15, 0.1), (15, -3.0), (15, np.nan)])
def test_a_time_that_jumps_costs_its_frame_alone(tmp_path, app, row, off_s):
    times_s = 500 + np.arange(20) / 15.0
    jumped = times_s.copy()
    jumped[row] += off_s
    recording = open_recording(_with_times(tmp_path, app, jumped))
    assert len(recording.index) == 19
    assert (np.diff(recording.timestamp_s) > 0).all()
    assert recording.timestamp_s[-1] == pytest.approx(times_s[-1] - times_s[0])
    assert recording.incomplete == pytest.approx(1 / 20)


@pytest.mark.parametrize("app", ["record3d", "stray"])
@pytest.mark.parametrize(("unit", "per_second"), [("milliseconds", 1e3), ("nanoseconds", 1e9)])
@pytest.mark.parametrize("rate_hz", [0.5, 60.0])
def test_video_times_in_other_units_are_read(tmp_path, app, unit, per_second, rate_hz):
    times_s = 500 + np.arange(20) / rate_hz
    recording = open_recording(_with_times(tmp_path, app, per_second * times_s))
    np.testing.assert_allclose(recording.timestamp_s, times_s - 500, atol=1e-5)
    assert f"time stamps seem to be {unit}, and are read as such" in recording.remarks


def test_depth_of_every_second_frame_is_complete(tmp_path):
    path = made_formats.video_and_depth(tmp_path / "a", walk(40))
    for file in sorted((path / "depth").iterdir())[1::2]:
        file.unlink()
    recording = open_recording(path)
    assert (len(recording.index), recording.incomplete) == (20, 0.0)


def test_depth_that_counts_by_itself_at_half_the_rate_is_refused(tmp_path):
    """Depth at 30 Hz beside video at 60: every frame would get the depth of another time."""
    path = made_formats.video_and_depth(tmp_path / "a", walk(40))
    for number in range(20, 40):
        (path / f"depth/{number:06d}.png").unlink()
    with pytest.raises(InputError, match="CAP-004.*40 video frames, but depth up to number 19"):
        open_recording(path)


def test_record3d_files_that_are_numbered_from_1_are_refused(tmp_path):
    """Renamed by another program: every frame would get the time and pose of its neighbor."""
    made = walk(20)
    with zipfile.ZipFile(made.write(tmp_path / "a.r3d")) as archive:
        whole = {name: archive.read(name) for name in archive.namelist() if name != "metadata"}
    later = {name: f"rgbd/{int(Path(name).stem) + 1}{Path(name).suffix}" for name in whole}
    made.members = {name: None for name in whole} | {later[name]: whole[name] for name in whole}
    with pytest.raises(InputError, match="CAP-004.*each file is numbered from 1 to 20"):
        open_recording(made.write(tmp_path / "a.r3d"))
    made.members |= {"rgbd/20.jpg": None, "rgbd/20.depth": None}
    assert open_recording(made.write(tmp_path / "a.r3d")).index.tolist() == list(range(1, 20))


@pytest.mark.parametrize(
    ("numbered", "what"),
    [
        (lambda number: str(number + 1), "poses.txt is numbered from 1 to 40"),
        (lambda number: f"{number / 15:.4f}", "column 1 must be the frame's number"),
    ],
)
def test_poses_of_other_frames_are_refused(tmp_path, numbered, what):
    path = made_formats.video_and_depth(tmp_path / "a", walk(40))
    rows = [row.split() for row in (path / "poses.txt").read_text().split("\n")]
    text = "\n".join(" ".join([numbered(int(row[0])), *row[1:]]) for row in rows)
    (path / "poses.txt").write_text(text)
    with pytest.raises(InputError, match=f"CAP-004.*{what}"):
        open_recording(path)


@pytest.mark.parametrize("size", [100, 200_000])
def test_zeros_after_the_odometry_cost_nothing(tmp_path, size):
    """As after a copy that ended in a crash."""
    path = made_formats.stray(tmp_path / "a", walk(12))
    (path / "odometry.csv").write_bytes((path / "odometry.csv").read_bytes() + b"\n" + b"\0" * size)
    assert len(open_recording(path).index) == 12


def test_an_infinite_time_costs_its_row_only(tmp_path):
    path = made_formats.stray(tmp_path / "a", walk(12))
    rows = [row.split(", ") for row in (path / "odometry.csv").read_text().split("\n")]
    rows[5][0] = "inf"
    (path / "odometry.csv").write_text("\n".join(", ".join(row) for row in rows))
    recording = open_recording(path)
    assert recording.index.tolist() == [i for i in range(12) if i != 4]
    assert np.isfinite(recording.timestamp_s).all()


@pytest.mark.parametrize("width", ["NaN", "Infinity"])
def test_polycam_pictures_of_impossible_size_are_refused(tmp_path, width):
    path = made_formats.polycam(tmp_path / "a", walk(12))
    file = sorted((path / "keyframes/cameras").iterdir())[3]
    file.write_text(file.read_text().replace('"width": 48', f'"width": {width}'))
    with pytest.raises(InputError, match="CAP-004.*not a camera"):
        open_recording(path)


def test_intrinsics_may_hold_comments(tmp_path):
    made = walk(6)
    path = made_formats.video_and_depth(tmp_path / "a", made)
    (path / "intrinsics.txt").write_text("# fx fy cx cy\n" + (path / "intrinsics.txt").read_text())
    np.testing.assert_allclose(open_recording(path).intrinsics[0], made.intrinsics)


def test_tum_lists_may_name_files_from_here(tmp_path):
    path = made_formats.tum(tmp_path / "a", walk(6))
    for name in ("rgb", "depth"):
        text = (path / f"{name}.txt").read_text()
        (path / f"{name}.txt").write_text(text.replace(f" {name}/", f" ./{name}/"))
    assert len(open_recording(path).index) == 6


@pytest.mark.parametrize(("name", "code"), [("rgb.mp4", "CAP-001"), ("depth", "CAP-006")])
def test_links_inside_a_recording_are_named_as_such(tmp_path, name, code):
    path = made_formats.stray(tmp_path / "a", walk(6))
    (path / name).rename(tmp_path / name)
    (path / name).symlink_to(tmp_path / name)
    with pytest.raises(InputError, match=f"{code}.*links are not followed"):
        open_recording(path)


def test_tum_color_at_twice_the_rate_of_depth_is_that_of_its_time(tmp_path):
    """Half of the color pictures are 13 ms before the nearest depth, 4 ms after another color picture."""
    made = walk(40, rate_hz=60.0)
    path = made_formats.tum(tmp_path / "a", made)
    rows = (path / "depth.txt").read_text().split("\n")
    (path / "depth.txt").write_text("\n".join(rows[2::2]))
    recording = open_recording(path)
    np.testing.assert_allclose(recording.timestamp_s, made.timestamp_s[1::2] - made.timestamp_s[1], atol=1e-5)
    assert recording.incomplete == 0
    for number in range(20):
        np.testing.assert_allclose(recording.read_depth(number), made.depth(2 * number + 1), atol=1e-3)
