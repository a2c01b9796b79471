"""Exports preserve motion, positions and units in every format."""

import csv
import importlib
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.behavior.perception import FeatureVolume
from pipeline.core.errors import InputError
from pipeline.data import glb, images, npz
from pipeline.data.glb import Action
from pipeline.data.motion import Motion
from pipeline.geometry import rigid
from stages.export import bvh, cameras, mjcf, neuro, reading, retarget, splats, tables, usd, writing
from stages.export import glb as glb_export
from tests.stages.export import moving_tube
from tests.stages.export_simulator import small_world

RNG = np.random.default_rng(0)
WEB = Path(__file__).parents[3] / "stages/export_simulator/web"


@pytest.fixture(scope="module")
def agent() -> reading.Agent:
    """A tube of five bones with two motions."""
    mesh, skin = moving_tube.skinned_tube()
    actions = [
        Action(name, track.timestamp_s, track.world_from_agent, track.agent_from_bone.astype(np.float64))
        for name, track in (("walk", small_world.trajectory(20, 0)), ("turn", small_world.trajectory(12, 1)))
    ]
    return reading.Agent(mesh, skin, actions, 10.0, {"mean": 0.1, "max": 0.5})


@pytest.fixture
def session() -> Motion:
    track = small_world.trajectory(15, 0)
    agent = track.world_from_agent.copy()
    agent[4] = np.nan
    return Motion(
        track.timestamp_s + 4321.00123,
        track.world_from_camera,
        agent,
        track.agent_from_bone,
        np.full(15, 0.9),
        np.isfinite(agent).all((1, 2)),
    )


def test_retargeted_motion_is_exported_with_its_residual(agent: reading.Agent, tmp_path: Path) -> None:
    """A body 1.5 times as long has its own surface and skin, and the motions of the first."""
    stretch = np.array([1, 1, 1.5])
    rest = agent.skin.agent_from_bone_rest.copy()
    rest[:, :3, 3] *= stretch
    mesh = replace(agent.mesh, vertices=(agent.mesh.vertices * stretch).astype(np.float32))
    long = reading.Agent(mesh, replace(agent.skin, agent_from_bone_rest=rest), [], 30.0, {"mean": 0.2})
    moved = retarget.onto(agent, long)
    record = glb_export.write(tmp_path, moved, glb.static(agent.mesh, "room"))
    assert record.loss_mm["skinning_mean"] == 0.2 and record.loss_mm["retargeting_mean"] < 2, "mm"
    assert record.loss_mm["retargeting_shape_distance"] < 1e-3
    opened, _, actions = glb.read_skinned((tmp_path / "agent.glb").read_bytes())
    np.testing.assert_allclose(opened.vertices, mesh.vertices, atol=1e-6)
    assert [action.name for action in actions] == ["walk", "turn"]
    for found, truth in zip(actions, agent.actions, strict=True):
        np.testing.assert_allclose(found.time_s, truth.time_s, atol=1e-6)
        bent, own = (each.agent_from_bone[:, 1, 0, 2] for each in (truth, found))
        assert np.corrcoef(bent, own)[0, 1] > 0.9, "the second bone swings in the same rhythm"


def test_glb_round_trips(agent: reading.Agent) -> None:
    mesh, skin, actions = glb.read_skinned(glb.skinned(agent.mesh, agent.skin, agent.actions))
    np.testing.assert_array_equal(mesh.faces, agent.mesh.faces)
    np.testing.assert_array_equal(mesh.color, agent.mesh.color)
    np.testing.assert_array_equal(skin.joints, agent.skin.joints)
    np.testing.assert_array_equal(skin.weights, agent.skin.weights)
    np.testing.assert_allclose(skin.agent_from_bone_rest, agent.skin.agent_from_bone_rest, atol=1e-6)
    for found, truth in zip(actions, agent.actions, strict=True):
        np.testing.assert_allclose(found.world_from_agent, truth.world_from_agent, atol=1e-6)
        np.testing.assert_allclose(found.agent_from_bone, truth.agent_from_bone, atol=1e-6)
    still = glb.read_static(glb.static(agent.mesh, "tube"))
    np.testing.assert_array_equal(still.vertices, agent.mesh.vertices)


def test_glb_is_valid(agent: reading.Agent, tmp_path: Path) -> None:
    written = glb_export.write(tmp_path, agent, glb.static(small_world.room(), "scene"))
    assert written.loss_mm == {"skinning_mean": 0.1, "skinning_max": 0.5}
    if shutil.which("node") is None or not (WEB / "node_modules/gltf-validator").is_dir():
        pytest.skip("needs node, and `npm ci` in stages/export_simulator/web")
    script = (
        "import v from 'gltf-validator'; import fs from 'fs';"
        "for (const f of process.argv.slice(1)) {"
        "const r = await v.validateBytes(new Uint8Array(fs.readFileSync(f)));"
        "console.log(JSON.stringify([r.issues.numErrors, r.issues.numWarnings, r.info.animationCount]))}"
    )
    files = [str(tmp_path / name) for name in ("agent.glb", "scene.glb")]
    told_by_node = subprocess.run(
        ["node", "--input-type=module", "-e", script, *files],
        cwd=WEB,
        capture_output=True,
        text=True,
        check=True,
    )
    assert [json.loads(line) for line in told_by_node.stdout.splitlines()] == [[0, 0, 2], [0, 0, 0]]


def test_bvh_is_exact(agent: reading.Agent, tmp_path: Path) -> None:
    written = bvh.write(tmp_path, agent)
    assert written.loss_mm["flat_max"] < 0.01, "mm: six decimals"
    assert {path.name for path in tmp_path.iterdir()} == {"walk.flat.bvh", "turn.flat.bvh"}


def test_boxes_cover_exactly_the_solid_space() -> None:
    solid = RNG.random((9, 7, 8)) < 0.4
    solid[2:6, 1:4, 2:7] = True
    found = mjcf.boxes(solid)
    count = np.zeros(solid.shape, int)
    for low, high in found:
        count[tuple(slice(*pair) for pair in zip(low, high, strict=True))] += 1
    np.testing.assert_array_equal(count, solid.astype(int))
    assert len(found) < solid.sum()


def test_splats_have_248_bytes_and_valid_values(tmp_path: Path) -> None:
    rows = np.zeros((4, 62), np.float32)
    rows[:, 58], rows[1, 0], rows[2, 54] = 2.0, np.nan, -9
    written = splats.write(tmp_path, {"scene": rows, "agent": rows})
    head, _, body = (tmp_path / "scene.ply").read_bytes().partition(b"end_header\n")
    assert len(body) == 2 * 248 and b"element vertex 2" in head and written.loss_mm == {}
    np.testing.assert_array_equal(np.frombuffer(body, "<f4").reshape(-1, 62)[:, 58], 1)


def test_session_table_has_one_row_per_frame(session: Motion) -> None:
    table = dict(zip(tables.COLUMNS, tables.rows(session).T, strict=True))
    assert table["in_view"].sum() == 14 and np.isnan(table["x"][4]) and np.isnan(table["qw"][4])
    np.testing.assert_allclose(table["speed_m_s"][7:], 0.6, atol=0.01, err_msg="1.2 m radius at 0.5 rad/s")
    assert np.allclose(table["distance_m"][0], np.hypot(1.0, 0.0), atol=1e-6)


@pytest.fixture
def shots(tmp_path: Path) -> list[reading.CameraFrame]:
    """Three pictures of a session and one of the walk-through, with depth and masks."""
    track = small_world.trajectory(3, 0)
    for video, count in (("v000", 1), ("v002", 3)):
        for name in ("color", "depth"):
            (tmp_path / "frames" / video / name).mkdir(parents=True)
        for index in range(count):
            images.write_color(
                tmp_path / f"frames/{video}/color/{index:06d}.jpg", np.full((24, 32, 3), 120, np.uint8)
            )
            images.write_depth(
                tmp_path / f"frames/{video}/depth/{index:06d}.exr", np.full((12, 16), 1.234, np.float32)
            )
        camera = np.tile(np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), (count, 1, 1))
        npz.save(tmp_path / f"frames/{video}/frames.npz", intrinsics=camera)
        motion = tmp_path / "reconstruction" / ("templates" if video == "v000" else video)
        motion.mkdir(parents=True)
        cameras_of = track.world_from_camera[:count].copy()
        cameras_of[2:] = np.nan
        npz.save(motion / ("v000.npz" if video == "v000" else "motion.npz"), world_from_camera=cameras_of)
    (tmp_path / "masks/v002").mkdir(parents=True)
    for index in range(3):
        images.write_gray(
            tmp_path / f"masks/v002/{index:06d}.png",
            np.pad(np.full((4, 4), 255, np.uint8), ((0, 20), (0, 28))),
        )
    frames = {video: tmp_path / "frames" / video for video in ("v000", "v002")}
    return reading.camera_frames(tmp_path / "reconstruction", frames, {"v002": tmp_path / "masks/v002"}, 10)


def test_pictures_keep_their_cameras(shots: list[reading.CameraFrame], tmp_path: Path) -> None:
    assert [shot.name for shot in shots] == ["v000_000000", "v002_000000", "v002_000001"], (
        "a camera that is unknown is left out"
    )
    for name in ("colmap", "nerfstudio"):
        (tmp_path / name).mkdir()
    written = cameras.write_colmap(tmp_path / "colmap", shots, small_world.room())
    assert written.loss_mm["camera_places"] < 0.01, "mm"
    cameras.write_nerfstudio(tmp_path / "nerfstudio", shots)
    frame = json.loads((tmp_path / "nerfstudio/transforms.json").read_bytes())["frames"][1]
    seen = (
        np.linalg.inv(frame["transform_matrix"]) @ shots[1].world_from_camera @ np.array([0.1, 0.2, 1.0, 1.0])
    )
    np.testing.assert_allclose(
        seen[:3], [0.1, -0.2, -1.0], atol=1e-9, err_msg="OpenGL looks along -z, y is up"
    )
    mask = images.read_gray(tmp_path / "nerfstudio" / frame["mask_path"])
    assert mask[0, 0] == 0 and mask[-1, -1] == 255


def test_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", refuse)
    with pytest.raises(InputError, match="make extras") as raised:
        writing.extra("pxr.Usd", "usd-core")
    assert raised.value.code == "EXP-010"


def test_usd_joints_have_their_poses(agent: reading.Agent, tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    assert usd.write(tmp_path, agent, small_world.room()).loss_mm["joints"] < 0.01, "mm"


@pytest.mark.parametrize("rate_hz", [12.5, 30.0, 60.0])
def test_keys_are_even_however_the_page_rounds_its_times(
    agent: reading.Agent, rate_hz: float, tmp_path: Path
) -> None:
    pxr = pytest.importorskip("pxr.Usd")
    seconds = np.arange(131) / 30 + 1e-7
    poses = [
        rigid.interpolate_body(a.time_s, a.world_from_agent, a.agent_from_bone, seconds % 1)
        for a in agent.actions
    ]
    actions = [
        Action(a.name, seconds - seconds[0], *found) for a, found in zip(agent.actions, poses, strict=True)
    ]
    (tmp_path / "agent.glb").write_bytes(glb.skinned(agent.mesh, agent.skin, actions))
    about = {"agent": {"skinning_residual_mm": {"mean": 0.1}}}
    (tmp_path / "simulator.json").write_text(json.dumps(about))
    again = reading.agent(tmp_path, None, rate_hz)
    for action in again.actions:
        np.testing.assert_array_equal(action.time_s, np.arange(len(action.time_s)) / rate_hz)
    usd.write(tmp_path, again, small_world.room())
    stage = pxr.Stage.Open(str(tmp_path / "agent_walk.usdc"))
    assert stage.GetTimeCodesPerSecond() == rate_hz and stage.GetEndTimeCode() == len(action.time_s) - 1
    assert f"Frame Time: {1 / rate_hz:.8f}" in bvh.flat(
        again.actions[0], list(agent.skin.bone_names), rate_hz
    )


def test_mjcf_compiles_and_moves(agent: reading.Agent, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    occupancy = np.pad(np.ones((20, 1, 20), np.uint8), ((0, 0), (0, 5), (0, 0)))
    volume = FeatureVolume(np.zeros((0, *occupancy.shape)), occupancy, np.array([-1.0, -0.1, -1]), 0.1)
    assert mjcf.write(tmp_path, agent, volume).loss_mm["bodies"] < 0.01, "mm"


def test_scientific_formats_round_trip(session: Motion, tmp_path: Path) -> None:
    pytest.importorskip("h5netcdf")
    pytest.importorskip("pynwb")
    pytest.importorskip("pyarrow")
    assert neuro.write_movement(tmp_path, {"v002": session}).loss_mm["largest"] < 1e-6, "mm"
    assert neuro.write_nwb(tmp_path, {"v002": session}).loss_mm["largest"] < 1e-6, "mm"
    tables.write(tmp_path, {"v002": session})
    with open(tmp_path / "frames.csv", newline="") as file:
        written = list(csv.DictReader(file))
    assert len(written) == 15 and written[4]["x"] == "", "unknown"
    seconds = [float(row["time_s"]) for row in written]
    np.testing.assert_allclose(
        seconds, session.timestamp_s, atol=1e-6, rtol=0, err_msg="also of long recordings"
    )


def test_extras_agree_with_the_locks_and_exclude_torch() -> None:
    envs = Path(__file__).parents[3] / "envs"

    def pinned(name: str) -> dict[str, str]:
        lines = (
            line.split()[0].split("==") for line in (envs / name).read_text().splitlines() if "==" in line
        )
        return {package: version for package, version in lines}

    extras, core = pinned("extras.txt"), pinned("cuda.txt")
    assert not {"torch", "torchvision", "triton"} & set(extras)
    assert {package for package in extras if package in core and core[package] != extras[package]} == set()
