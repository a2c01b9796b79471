from dataclasses import replace

import numpy as np
import pytest

from pipeline.behavior.trajectories import KINDS, TEST, TRAIN, window_starts
from pipeline.core.errors import InputError
from pipeline.core.videos import Video
from pipeline.data import npz
from pipeline.geometry import rigid
from stages.slice_behavior import reading
from stages.slice_behavior.config import Config
from stages.slice_behavior.gridding import ReconstructedMotion, trajectory_from_motion
from stages.slice_behavior.stage import Inputs, run
from stages.slice_behavior.windows import allowed_voxels, slice_windows
from tests.pipeline.behavior.wandering import REST, room, wander

OPTIONS = {"min_confidence": 0.5, "max_gap_s": 0.6, "smooth_s": 0.0}


def jittered(rng: np.random.Generator, seconds: float = 20.0) -> ReconstructedMotion:
    """A steady walk along x with a constant turn rate, sampled at uneven times."""
    time = np.arange(0, seconds, 0.1) + rng.uniform(-0.03, 0.03, round(seconds * 10))
    time -= time[0]
    turn = rigid.rotation_from_vector(np.stack([0 * time, 0.2 * time, 0 * time], axis=-1))
    agent = rigid.make(turn, np.stack([0.1 * time, 0 * time + 0.2, 0 * time], axis=-1))
    bones = np.broadcast_to(REST, (len(time), *REST.shape)).copy()
    camera = rigid.make(
        np.broadcast_to(np.eye(3), turn.shape), np.stack([0.05 * time, 0 * time + 1, 0 * time], axis=-1)
    )
    return ReconstructedMotion(time, camera, agent, bones, np.ones(len(time)), np.ones(len(time), bool))


def test_uneven_times_are_resampled_exactly():
    trajectory = trajectory_from_motion(jittered(np.random.default_rng(0)), **OPTIONS)
    np.testing.assert_allclose(np.diff(trajectory.timestamp_s), 0.1, atol=1e-9)
    assert trajectory.valid.all()
    np.testing.assert_allclose(
        trajectory.world_from_agent[:-1, 0, 3], 0.1 * trajectory.timestamp_s[:-1], atol=1e-9
    )
    np.testing.assert_allclose(
        trajectory.world_from_camera[:-1, 0, 3], 0.05 * trajectory.timestamp_s[:-1], atol=1e-9
    )


def test_companions_are_resampled_where_present():
    motion = jittered(np.random.default_rng(0))
    being = np.full((len(motion.timestamp_s), 2, 4), np.nan)
    being[50:100, 1] = np.stack([0.3 * motion.timestamp_s[50:100], *np.ones((3, 50))], -1)
    trajectory = trajectory_from_motion(replace(motion, companions=being), **OPTIONS)
    there = np.isfinite(trajectory.companions).all(-1)
    assert not there[:, 0].any() and there[51:99, 1].all() and there[:, 1].sum() <= 51
    found = trajectory.companions[there[:, 1], 1]
    np.testing.assert_allclose(found[1:-1, 0], 0.3 * trajectory.timestamp_s[there[:, 1]][1:-1], atol=1e-5)
    assert (found[:, 3] == 1).all()


def test_other_animal_is_a_companion_where_visible():
    mine, its = (jittered(np.random.default_rng(0), 3.0) for _ in range(2))
    seen = np.arange(len(its.timestamp_s)) % 3 > 0
    its = replace(its, agent_visible=seen, confidence=np.where(seen, 0.9, 0.0))
    track = reading.companion_of(its, mine.timestamp_s, min_confidence=0.3)
    assert np.isnan(track[~seen]).all()
    np.testing.assert_array_equal(track[seen, :3], its.world_from_agent[seen, :3, 3])
    assert (track[seen, 3] == KINDS.index("animal")).all()
    trajectory = trajectory_from_motion(replace(mine, companions=track[:, None]), **OPTIONS)
    assert np.isfinite(trajectory.companions).all((1, 2)).mean() > 0.9, "short gaps are bridged"


def test_short_gaps_are_interpolated_and_uncertain_frames_are_gaps():
    motion = jittered(np.random.default_rng(0))
    agent = motion.world_from_agent.copy()
    confidence = motion.confidence.copy()
    visible = motion.agent_visible.copy()
    agent[50:53] = np.nan
    confidence[100:120] = 0.1
    visible[150:153] = visible[160:175] = False
    holed = replace(motion, world_from_agent=agent, confidence=confidence, agent_visible=visible)
    trajectory = trajectory_from_motion(holed, **OPTIONS)
    assert trajectory.valid[45:60].all()
    np.testing.assert_allclose(
        trajectory.world_from_agent[45:60, 0, 3], 0.1 * trajectory.timestamp_s[45:60], atol=1e-9
    )
    assert not trajectory.valid[101:119].any()
    assert trajectory.valid[122:159].all()
    assert not trajectory.valid[161:174].any(), (
        "what nobody saw for so long is no motion, whatever stands there"
    )
    assert trajectory.valid[177:].all()
    assert np.isfinite(trajectory.world_from_agent).all()


def test_invisible_agent_has_no_valid_frames():
    motion = jittered(np.random.default_rng(0))
    trajectory = trajectory_from_motion(
        replace(motion, world_from_agent=motion.world_from_agent * np.nan), **OPTIONS
    )
    assert not trajectory.valid.any()
    assert np.isfinite(trajectory.world_from_agent).all()


def test_smoothing_removes_jitter_and_keeps_rotations():
    rng = np.random.default_rng(0)
    clean = wander(rng).world_from_agent
    noisy = clean @ rigid.exp(rng.standard_normal((len(clean), 6)) * 0.02)
    smooth = rigid.smoothed(noisy, 1.0)
    np.testing.assert_allclose(np.linalg.det(smooth[:, :3, :3]), 1, atol=1e-9)
    error = [
        np.linalg.norm(track[5:-5, :3, 3] - clean[5:-5, :3, 3], axis=-1).mean() for track in (smooth, noisy)
    ]
    assert error[0] < 0.7 * error[1]


def test_windows_contain_only_valid_frames_of_one_recording():
    rng = np.random.default_rng(0)
    trajectories = {name: wander(rng) for name in ("v002", "v003", "v004")}
    trajectories["v003"].valid[70] = False
    data = slice_windows(trajectories, frozenset({"v004"}), REST, stride=1)
    assert len(window_starts(np.ones(120, bool), 64)) == 120 - 63
    assert (data.video == 0).sum() == 120 - 63
    assert (data.video == 1).sum() == 7
    for video, start in zip(data.video, data.start, strict=True):
        assert trajectories[data.videos[video]].valid[start : start + 64].all()
    assert {data.videos[v] for v in data.video[data.indices(TEST)]} == {"v004"}
    assert {data.videos[v] for v in data.video[data.indices(TRAIN)]} == {"v002", "v003"}


def test_short_recording_has_no_window():
    assert len(window_starts(np.ones(63, bool), 64)) == 0


def test_sparse_rows_are_refused_with_a_remedy(tmp_path):
    still = np.tile(np.eye(4), (60, 1, 1))
    folder = tmp_path / "v000"
    folder.mkdir()
    motion = {
        "world_from_agent": still,
        "world_from_camera": still,
        "agent_from_bone": still[:, None],
        "confidence": np.ones(60),
    }
    npz.save(folder / "motion.npz", timestamp_s=np.arange(60.0), agent_visible=np.ones(60, bool), **motion)
    npz.save(folder / "skin.npz", agent_from_bone_rest=still[:1])
    npz.save(folder / "feature_volume.npz", **vars(room()))
    videos = (Video("v000", "a.csv", "session", "train", None),)
    inputs, out = Inputs(trajectories={"v000": folder}), tmp_path / "behavior_data"
    out.mkdir()
    with pytest.raises(InputError, match="BEH-001(.|\n)*max_gap_s"):
        run(inputs, Config(), out, videos=videos)
    run(inputs, Config(max_gap_s=1.5), out, videos=videos)
    assert (out / "windows.npz").is_file() and (out / "volume.npz").is_file()


def test_allowed_positions_are_free_or_visited():
    volume, trajectory = room(), wander(np.random.default_rng(0))
    volume.occupancy[22, 4, 22] = 2
    allowed = allowed_voxels(volume, [], reach_voxels=2)
    assert allowed[20, 4, 20] == 1
    assert allowed[22, 4, 22] == 0
    assert allowed[0, 4, 20] == 0
    voxel, _ = volume.voxel(trajectory.world_from_agent[:, :3, 3])
    volume.occupancy[tuple(voxel.T)] = 1
    assert allowed_voxels(volume, [trajectory], reach_voxels=0)[tuple(voxel.T)].all()
