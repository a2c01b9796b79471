"""Table 1: every frame counts, rejected recordings are failures, ablations are compared in pairs."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.core.videos import Video
from pipeline.data import npz
from pipeline.data.poses import RegisteredPoses
from pipeline.data.templates import SceneCameras
from pipeline.geometry import rigid
from stages.evaluate.registration_tables import table
from tests.stages.textured_room import walk

VIDEOS = [
    Video("v000", "walkthrough.r3d", "walkthrough", "none", None, None, 0.0),
    Video("v001", "a.r3d", "session", "train", None, None, 0.0),
    Video("v002", "b.r3d", "session", "test", None, None, 0.0),
]


@pytest.fixture
def capture(tmp_path):
    """Write ground truth in its own world, and registrations with errors of 1 degree (ours) and 3 degrees (an
    ablation).
    """
    world, count = rigid.exp(np.array([0, 0.7, 0, 1.0, 0, 2.0])), 40
    for name in ("truth", "template"):
        (tmp_path / name).mkdir()
    frames = {}
    for number, video in enumerate(VIDEOS):
        cameras = walk(count, seed=number)
        moved = rigid.inverse(world) @ cameras
        plain = {
            "intrinsics": np.zeros((count, 3, 3)),
            "agent_visible": np.zeros(count, bool),
            "moving": np.zeros(count, bool),
        }
        npz.save(tmp_path / "truth" / f"{video.file[:-4]}.npz", world_from_camera=moved, **plain)
        frames[video.id] = tmp_path / "frames" / video.id
        frames[video.id].mkdir(parents=True)
        npz.save(
            frames[video.id] / "frames.npz", source_index=np.arange(count), timestamp_s=np.arange(count) * 0.5
        )
        if video.role == "walkthrough":
            lens = np.repeat(np.eye(3)[None], count, axis=0)
            SceneCameras(np.arange(count) * 0.5, cameras, lens, *np.ones((2, count), bool)).write(
                tmp_path / "template"
            )
            continue
        for variant, degrees in (("ours", 1.0), ("worse", 3.0)):
            if (variant, video.id) != ("worse", "v002"):
                wrong = cameras @ rigid.exp(np.array([np.deg2rad(degrees), 0, 0, 0.01 * degrees, 0, 0]))
                (tmp_path / variant / video.id).mkdir(parents=True)
                poses = replace(
                    RegisteredPoses.unknown(np.arange(count) * 0.5),
                    world_from_camera=wrong,
                    confidence=np.ones(count),
                )
                poses.write(tmp_path / variant / video.id)
    return tmp_path, frames


def test_ablations_are_compared_frame_by_frame(capture):
    folder, frames = capture
    rng = np.random.default_rng(0)
    both = {name: folder / name for name in ("ours", "worse")}
    values = table.metrics(both, frames, VIDEOS, folder / "template", folder / "truth", rng).values
    assert values["ours/rotation_deg_median"] == pytest.approx(1.0, abs=1e-6)
    assert values["ours/translation_m_median"] == pytest.approx(0.01, abs=1e-6)
    assert values["worse/videos_registered"] == 1
    assert values["worse/rotation_deg_p95"] is None, "half of the frames have no pose"
    assert values["worse/rotation_deg_more_than_ours"] == pytest.approx(
        (2.0 + table.MAX_DEG - 1.0) / 2, abs=1e-3
    )
    low, high = (values[f"worse/rotation_deg_more_than_ours_ci95_{end}"] for end in ("low", "high"))
    assert low < values["worse/rotation_deg_more_than_ours"] < high
    assert values["worse/v001/rotation_deg_more_than_ours"] == pytest.approx(2.0, abs=1e-6)
    assert values["worse/v001/rotation_deg_median"] == pytest.approx(3.0, abs=1e-6)
    assert values["worse/v002/rotation_deg_median"] is None
    text = table.text(values, ("ours", "worse"))
    assert "6.35 / 0.41" in text
    assert "1/2" in text


def test_no_table_without_ground_truth(capture):
    folder, frames = capture
    rng = np.random.default_rng(0)
    found = table.metrics({"ours": folder / "ours"}, frames, VIDEOS, folder / "template", None, rng)
    assert set(found.values.values()) == {None}
    assert set(found.values) == set(found.reasons)
