"""Evaluation against the held-out phone during its session; a rejected session counts as wrong everywhere."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from pipeline.core.videos import Video
from pipeline.geometry import cameras
from stages.evaluate import heldout, reading, real_phone, reconstruction
from stages.evaluate.heldout import HeldoutShot, HeldoutView
from stages.evaluate.reading import BuildFolders
from tests.stages.written_frames import write_frames

PHONE = Video("v002", "heldout.r3d", "heldout", "none", None, "v001", 0.35)


@pytest.fixture
def folders(tmp_path: Path) -> BuildFolders:
    """A session of 1 s and a phone that records 0.35 s longer, without a reconstruction."""
    for id in ("v001", "v002"):
        write_frames(tmp_path / "frames" / id, [np.full((9, 7, 3), 99, np.uint8)] * 11, np.full((9, 7), 2.0))
    nowhere = {field.name: tmp_path for field in fields(BuildFolders)} | {
        "truth": None,
        "masks": {},
        "flow": {},
    }
    return BuildFolders(**nowhere | {"frames": {id: tmp_path / "frames" / id for id in ("v001", "v002")}})


def test_only_frames_during_the_session_count(folders: BuildFolders):
    assert reading.filmed_together(folders, PHONE).tolist() == [0, 1, 2, 3, 4, 5, 6]
    known = np.tile(np.eye(4), (11, 1, 1))
    known[0] = np.nan
    shots = real_phone.shots(folders, PHONE, known, 3)
    np.testing.assert_allclose([shot.time_s for shot in shots], [0.45, 0.65, 0.95])
    before = Video("v002", "heldout.r3d", "heldout", "none", None, "v001", -5.0)
    assert len(real_phone.shots(folders, before, known, 3)) == 0


def test_rejected_session_is_wrong_everywhere(folders: BuildFolders):
    agent = np.arange(63).reshape(9, 7) < 12
    shot = HeldoutShot(
        np.eye(4), np.eye(3), 0.0, np.full((9, 7, 3), 99, np.uint8), np.full((9, 7), 2.0, np.float32), agent
    )
    values = reconstruction.held_out_metrics(folders, [("v001", [shot, shot]), ("v001", [])], "cpu").values
    for kind in ("depth_acc", "rendered_depth_acc"):
        assert [values[f"reconstruction/{kind}_{part}"] for part in ("all", "agent", "scene")] == [0, 0, 0]
    assert values["reconstruction/psnr_all"] < 10 and values["splats/psnr_all"] < 10
    assert [
        values[f"reconstruction/heldout_{what}"] for what in ("phones_drawn", "phones_total", "frames")
    ] == [0, 2, 2]


def test_regions_seen_by_the_session_are_evaluated_separately():
    agent = np.arange(63).reshape(9, 7) < 12
    depth, color = np.full((9, 7), 2.0, np.float32), np.zeros((9, 7, 3), np.uint8)
    views = [
        HeldoutView(color, depth + wrong, HeldoutShot(np.eye(4), np.eye(3), 0.0, color, depth, agent, share))
        for wrong, share in ((0.0, 0.02), (0.5, 0.0), (0.0, 0.0), (0.5, 0.01))
    ]
    values = heldout.filmed_metrics(views).values
    assert values["reconstruction/depth_acc_agent_filmed"] == 0.5
    assert values["reconstruction/agent_filmed_share"] == 0.5
    unknown = [HeldoutView(color, depth, HeldoutShot(np.eye(4), np.eye(3), 0.0, color, depth, agent))]
    assert set(heldout.filmed_metrics(unknown).values.values()) == {None}


def test_subsampled_views_keep_their_rays():
    rng, lens = np.random.default_rng(0), np.array([[50.0, 0, 31.0], [0, 52.0, 19.0], [0, 0, 1]])
    depth = rng.uniform(1, 3, (40, 61)).astype(np.float32)
    color = rng.integers(0, 255, (40, 61, 3), dtype=np.uint8)
    shot = HeldoutShot(np.eye(4), lens, 0.0, color, depth, depth > 2)
    points = cameras.back_project(depth, lens)
    (few,) = heldout.thinned([shot], 100)
    assert few.depth.size <= 120 and len(few.color) == len(few.agent) == len(few.depth)
    lifted = cameras.back_project(few.depth, few.intrinsics)
    np.testing.assert_allclose(lifted, points[2::5, 2::5], atol=1e-6)
    assert (heldout.thinned([shot], 10_000)[0].depth == depth).all()


def test_no_metrics_without_a_held_out_phone(folders: BuildFolders):
    metrics = reconstruction.held_out_metrics(folders, [], "cpu")
    assert (
        metrics.values["reconstruction/depth_acc_all"] is None
        and metrics.values["reconstruction/heldout_phones_total"] == 0
    )
