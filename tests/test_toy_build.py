"""The whole way through with the toy: every artifact stands, the figures reach their bars, nothing runs
twice.
"""

import json
import subprocess
from pathlib import Path

import pytest

from pipeline.workflow import artifact, dag

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.toy

AT_MOST = {
    "registration/rotation_deg_median": 1.0,
    "registration/translation_m_median": 0.04,
    "reconstruction/agent_root_m_median": 0.08,
}
AT_LEAST = {"masks/iou_mean": 0.75, "reconstruction/depth_acc_all": 0.88, "registration/videos_registered": 2}


@pytest.fixture(scope="module")
def metrics(toy):
    return json.loads((toy / "evaluation" / "metrics.json").read_text())


@pytest.fixture(scope="module")
def jobs(toy):
    """What `make toy` makes; tables stand aside."""
    return [job for job in json.loads((toy / "plan" / "dag.json").read_text()) if not job["on_demand"]]


def test_every_artifact_is_complete(jobs):
    assert {job["artifact"] for job in jobs} == {
        node.artifact for node in dag.nodes_of("recordings") if not (node.on_demand or node.mapped)
    }
    for job in jobs:
        manifest = artifact.opened(ROOT / job["out"], job["id"])
        assert manifest.files == artifact.digests(ROOT / job["out"]), job["id"]


def test_every_artifact_judges_itself(jobs):
    """And none of them with a fail."""
    for job in jobs:
        told = json.loads((ROOT / job["out"] / "qa.json").read_text())
        failed = [check for check in told["checks"] if check["status"] == "fail"]
        assert not failed, f"{job['id']}: {failed}"
        assert all((ROOT / job["out"] / picture["file"]).is_file() for picture in told["pictures"])


@pytest.mark.parametrize("name", AT_MOST)
def test_errors_stay_below_their_bars(metrics, name):
    assert metrics[name] <= AT_MOST[name]


@pytest.mark.parametrize("name", AT_LEAST)
def test_scores_reach_their_bars(metrics, name):
    assert metrics[name] >= AT_LEAST[name]


def test_toy_videos_are_long_enough_to_learn_from(toy):
    """A window is 8 + 56 frames; a video of 90 frames holds a few."""
    for video in json.loads((toy / "plan" / "videos.json").read_text()):
        if video["role"] == "session":
            assert len(list((toy / "frames" / video["id"] / "color").iterdir())) >= 90


def test_a_second_make_runs_no_stage(toy):
    again = subprocess.run(["make", "toy"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "begins" not in again.stderr
    assert "build/toy/report/index.html" in again.stdout


def test_snakemake_finds_it_up_to_date(toy):
    command = [".venv/bin/python", "-m", "snakemake", "--cores", "2", "--config", "agent=toy"]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert "Nothing to be done" in told.stdout + told.stderr, told.stderr
