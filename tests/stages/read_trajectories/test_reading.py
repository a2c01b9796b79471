"""Motion tables: round trip, inference of the kinematic tree from joints, and refusal of invalid input."""

import zipfile

import numpy as np
import pytest

from pipeline.behavior.trajectories import ABSENT_M
from pipeline.core.errors import InputError
from pipeline.geometry import rigid
from stages.read_trajectories import captured, pictures, reading
from stages.read_trajectories.config import Config
from stages.read_trajectories.motion import CLIP_GAP_S, concatenated_times
from stages.read_trajectories.reading import read

READING = Config(root_joint=0, front_joint=2)


def table(path, rows, header="id,time,x,y,z,heading"):
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def test_table_is_converted_to_poses_per_id(tmp_path):
    rows = [f"{name},{0.1 * i},{i * 0.01},0.2,{-i * 0.02},{0.1 * i}" for name in ("b", "a") for i in range(5)]
    motion = read(table(tmp_path / "t.csv", rows), READING)
    assert len(motion.timestamp_s) == 10
    assert motion.timestamp_s[5] - motion.timestamp_s[4] == pytest.approx(CLIP_GAP_S)
    np.testing.assert_allclose(motion.world_from_agent[4, :3, 3], [0.04, 0.2, -0.08])
    np.testing.assert_allclose(motion.world_from_agent[4, :3, 2], [np.sin(0.4), 0, np.cos(0.4)], atol=1e-12)
    assert (motion.world_from_camera[:, 0, 3] == ABSENT_M).all()


def test_distant_segments_become_clips_of_one_recording(tmp_path):
    rows = [f"{1.7e9 + 86400 * day + 0.1 * i:.1f},{i * 0.01},0.2,0,0" for day in (0, 1, 7) for i in range(20)]
    time = read(table(tmp_path / "t.csv", rows, "time,x,y,z,heading"), READING).timestamp_s
    step = np.diff(time)
    assert len(time) == 60 and time[0] == 0
    np.testing.assert_allclose(step[[19, 39]], CLIP_GAP_S, rtol=1e-5)  # times of 1.7e9 s hold 0.2 us
    np.testing.assert_allclose(np.delete(step, [19, 39]), 0.1, atol=1e-6)


def test_invisible_rows_and_observers_are_separated(tmp_path):
    rows = ["a,0.0,1,0,2,0,3,1,4", "a,0.1,,,,,3,1,4", "a,0.2,1,0,2,0,,,"]
    motion = read(
        table(tmp_path / "t.csv", rows, "id,time,x,y,z,heading,observer_x,observer_y,observer_z"), READING
    )
    assert motion.arrays()["agent_visible"].tolist() == [True, False, True]
    np.testing.assert_allclose(motion.world_from_camera[0, :3, 3], [3, 1, 4])
    assert motion.world_from_camera[2, 0, 3] == ABSENT_M


def test_ids_of_a_table_with_kinds_share_timestamps(tmp_path):
    def rows(name, kind, begin, end, x):
        return [f"{name},{kind},{0.1 * i:.1f},{x},0,{0.01 * i:.2f},0" for i in range(begin, end)]

    lines = rows("cat", "animal", 0, 100, 0) + rows("dog", "animal", 20, 60, 1)
    lines += rows("ann", "person", 0, 30, 2) + rows("bob", "person", 90, 100, 3)
    motion = read(table(tmp_path / "t.csv", lines, "id,kind,time,x,y,z,heading"), READING)
    assert len(motion.timestamp_s) == 140, "people are not learned from"
    cat, dog = motion.companions[:100], motion.companions[100:]
    assert cat.shape[1] == 2, "bob comes long after ann has gone and takes her column"
    present = {float(x): np.flatnonzero((cat[..., 0] == x).any(1)) for x in (1, 2, 3)}
    assert [(frames[0], frames[-1]) for frames in present.values()] == [(20, 59), (0, 29), (90, 99)]
    ann = cat[:30][cat[:30, :, 0] == 2]
    np.testing.assert_allclose(ann[:, 2], 0.01 * np.arange(30), atol=1e-6)
    assert (ann[:, 3] == 0).all() and (cat[cat[..., 0] == 1][:, 3] == 1).all()
    assert np.isfinite(dog[:, 0]).all() and (dog[:, :, 0] == 0).any(1).all()
    people = read(table(tmp_path / "p.csv", lines[140:], "id,kind,time,x,y,z,heading"), READING)
    assert len(people.timestamp_s) == 40, "of people alone, people are learned from"
    with pytest.raises(InputError, match="kind"):
        read(table(tmp_path / "w.csv", ["a,tree,0,0,0,0,0"], "id,kind,time,x,y,z,heading"), READING)


def test_obstacle_map_has_its_position(tmp_path):
    folder = tmp_path / "clip"
    folder.mkdir()
    table(folder / "trajectory.csv", [f"a,{0.1 * i},{0.1 * i},0.25,0,1.57" for i in range(20)])
    (folder / "obstacles.csv").write_text("x,z,bottom,top\n1.05,0.55,0,0.5\n")
    volume = read(folder, READING).volume
    for point, solid in (
        ((1.05, 0.25, 0.55), 1),
        ((1.05, 0.65, 0.55), 0),
        ((1.05, 0.25, 0.05), 0),
        ((1.0, -0.1, 0.0), 1),
    ):
        voxel, inside = volume.voxel(np.array(point))
        assert inside and volume.occupancy[tuple(voxel)] == solid, point
    assert volume.features[:, volume.occupancy == 0].sum() == 0


def skeleton_motion(frames=300):
    """A pelvis that turns and walks, a two-joint spine ahead, a swinging leg; the tree is 0 -> 1 -> 2, 0 -> 3
    -> 4.
    """
    swing = 0.6 * np.sin(np.arange(frames) * 0.2)
    leg = np.stack([0 * swing, -np.cos(swing), np.sin(swing)], axis=-1)
    bent = np.stack([0 * swing, -np.cos(2 * swing), np.sin(2 * swing)], axis=-1)
    nod = np.stack([0 * swing, 0.3 * np.sin(3 * swing), np.cos(0.3 * np.sin(3 * swing))], axis=-1)
    spine = np.broadcast_to([0, 0.02, 0.3], leg.shape)
    local = np.stack([0 * leg, spine, spine + 0.2 * nod, 0.2 * leg, 0.2 * leg + 0.15 * bent], axis=1)
    yaw = np.linspace(0, 3, frames)
    root = rigid.make(
        rigid.rotation_from_vector(np.stack([0 * yaw, yaw, 0 * yaw], -1)),
        np.stack([yaw, 0 * yaw + 0.5, 0.5 * yaw], -1),
    )
    return rigid.apply(root, local)


def test_kinematic_tree_is_inferred_and_bones_rotate_with_it():
    joints = skeleton_motion()
    parent = captured.parents(joints, 0)
    assert parent.tolist() == [-1, 0, 1, 0, 3]
    root = captured.root_from_joints(joints, Config(root_joint=0, front_joint=1))
    local = rigid.apply(rigid.inverse(root), joints)
    bones, rest = captured.bones_from_joints(local, parent)
    assert rest.shape == (5, 4, 4)
    along = np.einsum("fij,j->fi", bones[:, 3, :3, :3], _unit((local[:, 4] - local[:, 3]) / 0.15).mean(0))
    assert np.abs(np.cross(_unit(along), _unit(local[:, 4] - local[:, 3]))).max() < 1e-6


def _unit(vector):
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def test_clips_of_joints_stand_on_the_floor(tmp_path):
    joints = skeleton_motion() + np.array([0, 3.0, 0])
    np.savez(tmp_path / "clip.npz", walk=joints, run=joints[:100])
    motion = read(tmp_path / "clip.npz", READING)
    assert len(motion.timestamp_s) == 400
    lowest = rigid.apply(motion.world_from_agent, motion.agent_from_bone[:, :, :3, 3])[..., 1].min()
    assert abs(lowest) < 0.02
    np.testing.assert_allclose(np.linalg.det(motion.world_from_agent[:, :3, :3]), 1, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("time,x\n0,1\n", "TRJ-001.*no column y, z, heading"),
        ("id,time,x,y,z,heading\na,zero,0,0,0,0\n", "TRJ-001.*time is not numeric"),
        ("id,time,x,y,z,heading\n", "TRJ-002"),
        ("id,time,x,y,z,heading\na,0,,,,\n", "TRJ-002.*no position"),
        ("Time,X,Y,Z,Heading\n0,inf,0,0,0\n", "TRJ-002.*no position"),
        ("id,time,x,y,z,heading\na,1,0,0,0,0\na,1,1,0,0,0\n", "TRJ-001.*same time"),
        ("time,x,y,z,heading\n0,0,0,0,0\n100,0,0,0,0\n", "TRJ-001.*100 s apart"),
        (
            "time,x,y,z,heading\n0,431250.5,0,5402000,0\n1,431251,0,5402000,0\n",
            "TRJ-001.*5402 km away(.|\n)*subtract one origin",
        ),
        ("time;x;y;z;heading\n0,1;0,0;0,0;0,0;0,0\n", "TRJ-001.*line 2 has more cells"),
        ("time,x,y,z,heading,observer_x\n0,0,0,0,0,0\n", "TRJ-001.*no column observer_y, observer_z"),
    ],
)
def test_invalid_tables_are_refused(tmp_path, text, code):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match=code):
        read(tmp_path / "t.csv", READING)


@pytest.mark.parametrize(
    "stored", [{"depth": np.zeros((4, 5))}, {}, {"a": np.zeros((0, 5, 3))}, {"a": np.array(["x"])}]
)
def test_arrays_of_wrong_shape_are_refused(tmp_path, stored):
    np.savez(tmp_path / "t.npz", **stored)
    with pytest.raises(InputError, match="TRJ-001.*no joint positions"):
        read(tmp_path / "t.npz", READING)


@pytest.mark.parametrize("wrong", ["volume/origin", "timestamp_s", "agent_from_bone"])
def test_incomplete_motion_is_refused(tmp_path, wrong):
    poses, frames = np.tile(np.eye(4), (5, 1, 1)), np.arange(5) / 10
    stored = {"timestamp_s": frames, "world_from_agent": poses, "agent_from_bone": poses[:, None]}
    stored |= {"world_from_camera": poses, "agent_from_bone_rest": np.eye(4)[None]}
    stored |= {"volume/features": np.zeros((1, 1, 1, 1)), "volume/occupancy": np.zeros((1, 1, 1))}
    stored |= {"volume/origin": np.zeros(3), "volume/voxel_m": np.float64(0.1)}
    np.savez(tmp_path / "a.npz", **stored)
    assert len(read(tmp_path / "a.npz", READING).timestamp_s) == 5
    del stored[wrong]
    if "/" not in wrong:
        stored[wrong] = np.zeros(())
    np.savez(tmp_path / "a.npz", **stored)
    with pytest.raises(InputError, match="TRJ-001.*missing or of other shapes"):
        read(tmp_path / "a.npz", READING)


def test_table_that_expands_to_gigabytes_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open("a.npy", "w", force_zip64=True) as member:
            shape = (reading.MAX_BYTES // 24 + 1, 1, 3)
            header = {"descr": "<f8", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(member, header)
    data = (tmp_path / "a.npz").read_bytes()
    at = data.rindex(b"PK\x01\x02") + 24  # the directory declares the decompressed size
    (tmp_path / "a.npz").write_bytes(
        data[:at] + (reading.MAX_BYTES + 128).to_bytes(4, "little") + data[at + 4 :]
    )
    with pytest.raises(InputError, match="TRJ-001.*more than 2147483648 bytes"):
        read(tmp_path / "a.npz", READING)


def test_file_that_is_no_npz_is_refused(tmp_path):
    (tmp_path / "t.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match="TRJ-001.*no.* zip"):
        read(tmp_path / "t.npz", READING)


@pytest.mark.parametrize(("unit", "status"), [(1.0, "ok"), (180 / np.pi, "warn")])
def test_headings_in_degrees_are_refused(tmp_path, unit, status):
    rows = [f"{0.1 * i},{0.01 * i},0,0,{0.05 * np.sin(i) * unit}" for i in range(100)]
    found = {
        check.name: check.status
        for check in pictures.checks(read(table(tmp_path / "t.csv", rows, "time,x,y,z,heading"), READING))
    }
    assert found["turning, 99 % below"] == status


def test_unseen_rows_do_not_dilute_the_share_in_obstacles(tmp_path):
    folder = tmp_path / "clip"
    folder.mkdir()
    seen, unseen = ("1.05,0.25,0.55,0", ",,,")
    table(folder / "trajectory.csv", [f"a,{0.1 * i},{unseen if i % 2 else seen}" for i in range(41)])
    (folder / "obstacles.csv").write_text("x,z,bottom,top\n1.05,0.55,0,0.5\n")
    checks = pictures.checks(read(folder, READING))
    (solid,) = [check for check in checks if check.name == "positions in obstacles"]
    assert solid.value == 1 and solid.status == "fail"


def test_unknown_joints_are_refused(tmp_path):
    joints = skeleton_motion()
    joints[7, 2] = np.nan
    np.savez(tmp_path / "t.npz", walk=joints)
    with pytest.raises(InputError, match="TRJ-001.*not finite"):
        read(tmp_path / "t.npz", READING)


@pytest.mark.parametrize("cells", ["x,z\n,1\n", "x,z\n1e5,1e5\n"])
def test_impossible_obstacle_maps_are_refused(tmp_path, cells):
    (tmp_path / "trajectory.csv").write_text("time,x,y,z,heading\n0,0,0,0,0\n1,1,0,0,0\n")
    (tmp_path / "obstacles.csv").write_text(cells)
    with pytest.raises(InputError, match="TRJ-001"):
        read(tmp_path, READING)


@pytest.mark.parametrize("rate_hz", [2.5, 10.0, 60.0, 7.0])
def test_clips_start_on_the_grid_of_their_rate(rate_hz):
    """Slicing at that rate then keeps frames unchanged, without interpolation with later ones."""
    times = concatenated_times([3.0 + np.arange(count) / rate_hz for count in (9, 4, 21)])
    frame = times * rate_hz
    np.testing.assert_allclose(frame, frame.round(), atol=1e-6)
    assert np.diff(times).max() >= CLIP_GAP_S - 1e-6
