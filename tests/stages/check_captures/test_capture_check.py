"""Every problem of a recording is detected with its code; a good recording has none."""

import dataclasses
import re

import cv2
import numpy as np
import pytest

from pipeline.calibration.recordings import DepthCalibration, DepthEstimate
from pipeline.core.videos import Role
from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import RayCaster, render_view
from pipeline.mapping import picture_agreement
from pipeline.recordings.formats import open_recording
from stages.check_captures import __main__ as front
from stages.check_captures import moving_objects, overlap, parallax, problems, sampling, stage
from stages.check_captures.sampling import SampledFrame
from tests.pipeline.recordings import made_formats
from tests.stages import textured_room
from tests.stages.extract_frames.made_recordings import COLOR_SIZE, Made, walk


class Textured(Made):
    """A recording of walls with enough edges to be sharp."""

    brightness, sharp_until = 1.0, 10**6

    def color(self, frame: int) -> np.ndarray:
        size = self._size(COLOR_SIZE)
        rays = cameras.ray_directions(self.intrinsics, *size)
        camera = self.stored_from_upright(self.world_from_camera[frame])
        walls = rigid.apply(camera, (rays * self._wall_m(rays, camera)[..., None]).reshape(-1, 3))
        picture = textured_room.noise_color(walls, seed=0).reshape(*size, 3)
        if frame >= self.sharp_until:
            picture = np.full_like(picture, 120)
        return (self.brightness * picture).astype(np.uint8)


def _made(seconds: float = 10.0, turns: int = 0, rate_hz: float = 6.0) -> Textured:
    """A camera that moves back and forth, so that it revisits every place."""
    plain = walk(round(seconds * rate_hz), rate_hz)
    there_and_back = 1.5 - np.abs(plain.timestamp_s % 3.0 - 1.5)
    source = walk(200, 100.0).world_from_camera[np.rint(100 * there_and_back).astype(int)]
    return Textured(source, plain.timestamp_s, quarter_turns=turns)


def _codes(path, role: Role = "heldout") -> set[str]:
    sample = sampling.sample(open_recording(path), 20, max_depth_m=6.0)
    return {
        each.code
        for each in problems.problems(
            problems.CaptureMeasurements(sample, overlap.drift_m(sample.shots)), role
        )
    }


@pytest.mark.parametrize("turns", [0, 1])
def test_good_recording_has_no_problems_in_any_orientation(tmp_path, turns):
    assert _codes(_made(turns=turns).write(tmp_path / "a.r3d")) == set()


def _dark(made):
    made.brightness = 0.1


def _blurred(made):
    made.sharp_until = 20


def _gap(made):
    made.timestamp_s[30:] += 4


def _hollow(made):
    inner = made.depth
    made.depth = lambda frame: np.where(np.arange(inner(frame).shape[1]) % 4 > 0, 0, inner(frame)).astype(
        "<f4"
    )


def _far(made):
    inner = made.depth
    made.depth = lambda frame: np.where(
        np.arange(inner(frame).shape[1]) % 3 == 0, np.float32(7.5), inner(frame)
    )


def _identity(made):
    made.metadata["poses"] = [[0, 0, 0, 1, 0, 0, 0]] * len(made.timestamp_s)


def _other_axes(made):
    made.metadata["poses"] = made_formats.quaternion_poses(made).tolist()


def _drift(made):
    inner, seconds = made.poses(), made.timestamp_s
    inner[:, 4:] += 0.05 * seconds[:, None]
    made.metadata["poses"] = inner.tolist()


def _near(made):
    inner = made.depth
    made.depth = lambda frame: (0.8 * inner(frame)).astype("<f4")


def _turning(made):
    """Poses with a heading error that grows by 4 degrees per second."""
    angle = 0.07 * made.timestamp_s
    turned = rigid.make(rigid.rotation_from_yaw(angle), np.zeros((len(angle), 3)))
    made.metadata["poses"] = (
        dataclasses.replace(made, world_from_camera=turned @ made.world_from_camera).poses().tolist()
    )


FAULTS = {
    "CAP-032": _dark, "CAP-033": _blurred, "CAP-034": _gap, "CAP-037": _hollow, "CAP-038": _far, "CAP-050": _identity,
    "CAP-051": _other_axes, "CAP-052": _drift, "CAP-057": _near, "CAP-058": _turning,
}  # fmt: skip


@pytest.mark.parametrize("code", FAULTS)
def test_problem_is_reported_with_its_code(tmp_path, code):
    made = _made()
    FAULTS[code](made)
    assert code in _codes(made.write(tmp_path / "a.r3d"))


def test_short_or_sparse_recording_is_reported(tmp_path):
    assert "CAP-031" in _codes(_made(3.0).write(tmp_path / "a.r3d"))
    sample = sampling.sample(open_recording(tmp_path / "a.r3d"), 20, max_depth_m=6.0)
    times = np.linspace(0.0, 4.96, len(sample.recording.index))
    almost = dataclasses.replace(sample, recording=dataclasses.replace(sample.recording, timestamp_s=times))
    assert problems._of_pictures(almost, "heldout")["CAP-031"] == "only 4.9 s long"
    sparse = _made(12.0, rate_hz=1.0)
    assert "CAP-035" in _codes(made_formats.polycam(tmp_path / "b", sparse), "session")
    assert "CAP-035" not in _codes(tmp_path / "b", "walkthrough")


def test_damaged_pictures_and_missing_depth_are_reported(tmp_path):
    made = _made()
    made_formats.write_movie(tmp_path / "a.mp4", [made.color(i) for i in range(60)])
    assert "CAP-036" in _codes(tmp_path / "a.mp4")
    assert "CAP-039" in _codes(tmp_path / "a.mp4", "walkthrough")
    data = bytearray((tmp_path / "a.mp4").read_bytes())
    middle = len(data) // 2
    data[middle - 20_000 : middle + 20_000] = bytes(40_000)
    (tmp_path / "a.mp4").write_bytes(data)
    assert "CAP-030" in _codes(tmp_path / "a.mp4")
    made_formats.write_movie(tmp_path / "a.mkv", [made.color(i) for i in range(60)], rate=15)
    data = (tmp_path / "a.mkv").read_bytes()
    assert "CAP-030" not in _codes(tmp_path / "a.mkv")
    (tmp_path / "a.mkv").write_bytes(data[: len(data) * 2 // 3])
    assert "CAP-030" in _codes(tmp_path / "a.mkv")


def _shots(
    seed: int, count: int, offset: np.ndarray | None = None, balls=lambda frame: ()
) -> list[SampledFrame]:
    """Rendered views of a room with the given colors, with balls of (center, radius) per frame that are
    only in the depth.
    """
    mesh = textured_room.textured_room(seed, edge_m=0.08)
    caster = RayCaster(mesh)
    size = (240, 180)
    intrinsics = np.array([[178.0, 0, 90], [0, 178.0, 120], [0, 0, 1]])
    found = []
    for frame, camera in enumerate(textured_room.walk(count, seed=7)):
        depth, hits = render_view(caster, camera, intrinsics, *size)
        color = hits.interpolate(mesh, mesh.color).reshape(*size, 3)
        for center, radius in balls(frame):
            depth = np.minimum(depth, _ball(camera, intrinsics, size, center, radius))
        odometry = camera if offset is None else offset @ camera
        gray = color.mean(-1).astype(np.uint8)
        small = depth[1::3, 1::3].astype(np.float32)
        depth_intrinsics = cameras.scale_intrinsics(intrinsics, size, small.shape)
        found.append(
            SampledFrame(float(frame), gray, 20.0, 0.5, intrinsics, small, depth_intrinsics, odometry)
        )
    return found


def _ball(camera, intrinsics, size, center, radius):
    rays = cameras.ray_directions(intrinsics, *size)
    at = rigid.apply(rigid.inverse(camera), np.array([center]))[0]
    along, square = rays @ at, (rays**2).sum(-1)
    inside = along**2 - square * (at @ at - radius**2)
    return np.where(inside > 0, (along - np.sqrt(np.maximum(inside, 0))) / square, np.inf)


def test_room_is_recognized_and_another_is_not():
    rng = np.random.default_rng(0)
    offset = rigid.make(rigid.rotation_from_vector(np.array([0, 1.0, 0])), np.array([3.0, 0, 1]))
    room, again, other = (
        overlap.describe(shots) for shots in (_shots(0, 24), _shots(0, 9, offset), _shots(5, 9, offset))
    )
    assert overlap.placed_share(room, again, rng) > 0.5
    assert overlap.placed_share(room, other, rng) < problems.MIN_PLACED
    for share, describe_capture in ((0.01, {"CAP-053"}), (0.6, set())):
        sample = sampling.RecordingSample(*[None] * 2, [], 0.0)
        seen = problems.CaptureMeasurements(sample, placed=share)
        assert problems._of_content(seen, "session").keys() == describe_capture


def _calibrated(sample, **difference):
    """Return a sample whose depth camera was found 2.5 cm to the left, clearly, and used unless said otherwise."""
    estimate = DepthEstimate(0.9, rigid.make(np.eye(3), np.array([0.025, 0, 0])), 0.1, np.full(8, 0.001))
    clear = ("camera", "delay")
    found = DepthCalibration(sample.recording, estimate, clear, difference.pop("used", clear))
    return dataclasses.replace(sample, calibration=found, **difference)


@pytest.mark.parametrize(("factor", "codes"), [(1.0, {"CAP-060"}), (10.0, {"CAP-050"})])
def test_another_unit_of_depth_hides_what_follows_from_it(tmp_path, factor, codes):
    """Depth of a wrong unit is reprojected to a wrong place."""
    sample = sampling.sample(open_recording(_made().write(tmp_path / "a.r3d")), 20, max_depth_m=6.0)
    check = dataclasses.replace(sample.plan.pose_check, depth_factor=factor)
    odometry = sample.plan.odometry_from_camera if factor == 1 else None
    plan = dataclasses.replace(sample.plan, pose_check=check, odometry_from_camera=odometry)
    sample = _calibrated(sample)
    seen = problems.CaptureMeasurements(dataclasses.replace(sample, plan=plan))
    assert {each.code for each in problems.problems(seen, "heldout")} == codes


@pytest.mark.parametrize(("posed", "remedy"), [(True, "when tracking is ready"), (False, "add poses")])
def test_remedy_for_missing_poses_depends_on_why_they_are_missing(tmp_path, posed, remedy):
    made = _made(4.0, rate_hz=15.0)
    folder = made_formats.video_and_depth(tmp_path / "a", made, poses=posed)
    if posed:
        (folder / "poses.txt").write_text("\n".join(f"{i} 0 0 0 0 0 0 1" for i in range(60)))
    sample = sampling.sample(open_recording(folder), 20, max_depth_m=6.0)
    found = problems.problems(problems.CaptureMeasurements(sample), "session")
    assert remedy in {each.code: each.remedy for each in found}["CAP-050"]


@pytest.mark.parametrize(
    ("used", "what", "remedy"),
    [
        (("camera", "delay"), "the build corrects it", "write a.depth.toml: depth_intrinsics = ["),
        (("delay",), "what is given is used", "is depth_from_color the inverse"),
    ],
)
def test_another_depth_camera_is_reported_with_what_to_write(tmp_path, used, what, remedy):
    folder = made_formats.video_and_depth(tmp_path / "a", _made(2.0, rate_hz=15.0))
    sample = sampling.sample(open_recording(folder), 20, max_depth_m=6.0)
    assert sample.calibration is not None and sample.calibration.clear == ()
    seen = problems.CaptureMeasurements(_calibrated(sample, used=used))
    found = {each.code: each for each in problems.problems(seen, "session")}["CAP-060"]
    assert what in found.what and "0.900 +- 0.001 times" in found.what
    assert remedy in found.remedy and "delay_s = 0.1" in found.remedy


def test_remedy_for_late_depth_speaks_of_time(tmp_path):
    sample = sampling.sample(open_recording(_made(2.0).write(tmp_path / "a.r3d")), 20, max_depth_m=6.0)
    for better, remedy in (("depth 0.2 s later", "shift the time stamps"), ("mirrored depth", "mirrored it")):
        agreement = picture_agreement.PictureAgreement("contradict", 0.5, 40, better, 0.9, 38)
        seen = problems.CaptureMeasurements(dataclasses.replace(sample, agreement=agreement))
        found = {each.code: each for each in problems.problems(seen, "heldout")}["CAP-057"]
        assert f"agree better with {better} than as stored" in found.what
        assert remedy in found.remedy


@pytest.mark.parametrize("factor", [1.0, 5.0])
def test_walk_through_gives_the_unit_of_depth_without_poses(tmp_path, factor):
    room = overlap.describe(_shots(0, 24))
    shots = [
        dataclasses.replace(shot, depth=shot.depth / np.float32(factor), odometry_from_camera=None)
        for shot in _shots(0, 20)
    ]
    assert overlap.depth_factor(room, overlap.describe(shots), np.random.default_rng(0)) == factor
    folder = made_formats.video_and_depth(tmp_path / "a", _made(2.0, rate_hz=15.0), poses=False)
    sample = dataclasses.replace(sampling.sample(open_recording(folder), 20, max_depth_m=6.0), shots=shots)
    seen = stage._seen(sample, "session", room, np.random.default_rng(0))
    found = {each.code: each.what for each in problems.problems(seen, "session")}
    assert ("times 5 would fit the walk-through" in found["CAP-050"]) == (factor == 5)


def test_movers_are_counted():
    def one(frame):
        return [((0.6 * np.sin(frame), 0.2, 0.6 * np.cos(frame)), 0.14)]

    def two(frame):
        return [
            ((0.8 * np.sin(frame), 0.2, 0.7 * np.cos(frame)), 0.14),
            ((-0.8 * np.sin(frame), 0.2, -0.7 * np.cos(frame)), 0.14),
        ]

    still = moving_objects.find_motion(_shots(0, 16))
    lone = moving_objects.find_motion(_shots(0, 16, balls=one))
    pair = moving_objects.find_motion(_shots(0, 16, balls=two))
    assert still.seen == 0
    assert lone.seen > 0.6
    assert lone.several < 0.2
    assert pair.several > problems.MAX_SEVERAL
    sample = sampling.RecordingSample(*[None] * 2, [], 0.0)
    codes = [
        problems._of_content(problems.CaptureMeasurements(sample, moving=seen), "session").keys()
        for seen in (still, lone, pair)
    ]
    assert codes == [{"CAP-054"}, set(), {"CAP-055"}]


def test_a_person_in_the_walk_through_is_reported():
    """A cat is too small to be told from the drift of poses, which must not warn."""

    def person(frame):
        return [((0.25 * frame - 1, 0.6, 0.5), 0.35)] if frame < 8 else []

    def cat(frame):
        return [((0.25 * frame - 1, 0.1, 0.5), 0.1)]

    drift = rigid.rotation_from_yaw(np.radians(2.0) * np.arange(16) / 16)
    still = [
        dataclasses.replace(
            shot, odometry_from_camera=rigid.make(turn, np.zeros(3)) @ shot.odometry_from_camera
        )
        for shot, turn in zip(_shots(0, 16), drift, strict=True)
    ]
    agree = picture_agreement.PictureAgreement("agree", 0.9, 40)
    sample = sampling.RecordingSample(None, None, [], 0.0, agree)
    doubted = dataclasses.replace(sample, agreement=dataclasses.replace(agree, verdict="unconfirmed"))

    def codes(shots, sample=sample, role="walkthrough"):
        moving = moving_objects.find_motion(shots)
        return set(problems._of_content(problems.CaptureMeasurements(sample, moving=moving), role))

    walked = _shots(0, 16, balls=person)
    assert codes(walked) == {"CAP-059"}
    assert codes(walked, doubted) == codes(walked, role="turnaround") == set()
    assert codes(still) == codes(_shots(0, 16, balls=cat)) == set()


def test_no_statement_without_poses():
    shots = [dataclasses.replace(shot, odometry_from_camera=None) for shot in _shots(0, 4)]
    assert moving_objects.find_motion(shots) is None
    assert np.isnan(overlap.drift_m(shots))


def test_subsampled_depth_keeps_its_geometry():
    made = _made(2.0)
    size, view = (512, 384), cameras.scale_intrinsics(made.intrinsics, COLOR_SIZE, (512, 384))
    depth = np.fromfunction(lambda row, column: 1 + 0.001 * row + 0.002 * column, size)
    plan = type(
        "Plan",
        (),
        {
            "depth_intrinsics": view[None],
            "intrinsics": view[None],
            "timestamp_s": [0.0],
            "odometry_from_camera": None,
        },
    )
    frame = type(
        "Frame",
        (),
        {"depth": depth, "color": np.zeros((*size, 3), np.uint8), "sharpness": 1.0, "brightness": 1.0},
    )
    shot = sampling._shot(plan, 0, frame, 0.0)
    whole = cameras.back_project(depth, view)[1::2, 1::2]
    np.testing.assert_allclose(cameras.back_project(shot.depth, shot.depth_intrinsics), whole, atol=1e-9)


def test_program_reports_all_problems_and_fails_like_a_build(tmp_path, capsys):
    assert front.main([str(tmp_path)]) == 2
    assert "CAP-042" in capsys.readouterr().err
    _made().write(tmp_path / "walkthrough.r3d")
    (tmp_path / "broken.r3d").write_bytes(b"PK")
    (tmp_path / "exported").mkdir()
    (tmp_path / "exported/metadata.json").write_text("{")
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / ".monday.mov.icloud").write_text("x")
    (tmp_path / "b\udcff.r3d").write_bytes(b"PK")
    (tmp_path / "dark.r3d").write_bytes(b"PK")
    (tmp_path / "dark.r3d.toml").write_text('role = "unused"\n')
    assert front.main([str(tmp_path)]) == 2
    describe_capture = capsys.readouterr().out
    for expected in (
        "CAP-041",
        "Record3D .r3d",
        "CAP-031",
        "CAP-001",
        "CAP-004 exported/metadata.json: ",
        "notes.txt",
        "'dark.r3d'  left out: its role is 'unused'",
        "'.monday.mov.icloud' (only in iCloud: download it in Finder)",
        "CAP-003); convert other videos to .mp4",
        "CAP-040",
        "turnaround",
    ):
        assert expected in describe_capture, describe_capture


def movie(path, frames: int) -> None:
    written = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (64, 48))
    for frame in range(frames):
        written.write(np.full((48, 64, 3), 40 * frame % 255, np.uint8))
    written.release()


def test_check_refuses_what_the_build_refuses(tmp_path, capsys):
    for name in ("walkthrough", "turnaround_cat", "turnaround_m\u00fcsli"):
        _made(3.0).write(tmp_path / f"{name}.r3d")
    movie(tmp_path / "heldout.mp4", 12)
    movie(tmp_path / "short.mp4", 3)
    unknown, inner = _made(3.0), _made(3.0).depth
    unknown.depth = lambda frame: np.where(np.arange(24) % 6 > 0, 0, inner(frame)).astype("<f4")
    unknown.write(tmp_path / "far.r3d")
    (tmp_path / "turnaround_cat.r3d.toml").write_text("splt = 'test'")
    assert front.main([str(tmp_path)]) == 2
    output = capsys.readouterr().out
    for expected in (
        "heldout\n  CAP-006 ",
        "session\n  CAP-007 no usable frames: 3 pictures",
        "session\n  CAP-007 no usable frames: 20% of the depth is known in 0 of ",
        "turnaround_cat.r3d.toml: unknown key",
    ):
        assert expected in output, output
    (tmp_path / "turnaround_cat.r3d.toml").unlink()
    assert front.main([str(tmp_path)]) == 2
    assert "CAP-043" in capsys.readouterr().out


def test_tables_of_motion_are_no_recordings(tmp_path, capsys):
    (tmp_path / "a.csv").write_text("x")
    (tmp_path / "luna.toml").write_text("[flow]\nbegins_at = 'trajectories'")
    assert front.main([str(tmp_path), "--recipe", str(tmp_path / "luna.toml")]) == 2
    assert re.search("CAP-042 .*tables of motion", capsys.readouterr().err)


@pytest.mark.parametrize("text", ["videos = 3", "[videos]\n'walkthrough.r3d' = 3"])
def test_invalid_recipe_is_refused(tmp_path, capsys, text):
    _made().write(tmp_path / "walkthrough.r3d")
    (tmp_path / "luna.toml").write_text(text)
    assert front.main([str(tmp_path), "--recipe", str(tmp_path / "luna.toml")]) == 2
    assert "REC-002" in capsys.readouterr().err


def _layers(near_step_px: int) -> list[SampledFrame]:
    """Pictures of a far and a near layer of blobs; per picture the far one moves by 4 pixels, the near one by
    its own step.
    """
    rng = np.random.default_rng(0)
    far, near = (
        cv2.normalize(cv2.GaussianBlur(rng.normal(size=(240, 600)), (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX)
        for _ in range(2)
    )
    shots = []
    for number in range(8):
        picture = far[:, 4 * number : 4 * number + 320].copy()
        picture[120:] = near[120:, near_step_px * number : near_step_px * number + 320]
        shots.append(SampledFrame(float(number), picture.astype(np.uint8), 20.0, 0.5))
    return shots


def test_pure_rotation_has_no_parallax():
    walked, turned = parallax.parallax(_layers(16)), parallax.parallax(_layers(4))
    assert min(walked.linked, turned.linked) > 0.8
    assert walked.with_parallax > 0.8
    assert turned.with_parallax < 0.2
    sample = sampling.RecordingSample(None, None, [], 0.0)
    assert list(problems._of_depth(problems.CaptureMeasurements(sample, parallax=turned), "walkthrough")) == [
        "CAP-039",
        "CAP-056",
    ]
    assert list(problems._of_depth(problems.CaptureMeasurements(sample, parallax=walked), "walkthrough")) == [
        "CAP-039"
    ]
