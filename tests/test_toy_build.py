"""End-to-end build of the toy: all artifacts are complete, metrics reach their targets, nothing runs twice."""

import json
import subprocess
from pathlib import Path

import pytest

from pipeline.workflow import artifact, dag

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.toy

MAX_ERRORS = {
    "registration/rotation_deg_median": 1.0,
    "registration/translation_m_median": 0.04,
    "reconstruction/agent_root_m_median": 0.08,
}
MIN_SCORES = {
    "masks/iou_mean": 0.75,
    "reconstruction/depth_acc_all": 0.88,
    "registration/videos_registered": 2,
}


@pytest.fixture(scope="module")
def metrics(toy):
    return json.loads((toy / "evaluation" / "metrics.json").read_text())


@pytest.fixture(scope="module")
def jobs(toy):
    """Jobs of `make toy`, without tables."""
    return [job for job in json.loads((toy / "plan" / "dag.json").read_text()) if not job["on_demand"]]


def test_every_artifact_is_complete(jobs):
    assert {job["artifact"] for job in jobs} == {
        node.artifact for node in dag.nodes_of("recordings") if not (node.on_demand or node.mapped)
    }
    for job in jobs:
        manifest = artifact.opened(ROOT / job["out"], job["id"])
        assert manifest.files == artifact.digests(ROOT / job["out"]), job["id"]


def test_no_quality_check_fails(jobs):
    for job in jobs:
        qa = json.loads((ROOT / job["out"] / "qa.json").read_text())
        failed = [check for check in qa["checks"] if check["status"] == "fail"]
        assert not failed, f"{job['id']}: {failed}"
        assert all((ROOT / job["out"] / picture["file"]).is_file() for picture in qa["pictures"])


@pytest.mark.parametrize("name", MAX_ERRORS)
def test_errors_are_within_their_limits(metrics, name):
    assert metrics[name] <= MAX_ERRORS[name]


@pytest.mark.parametrize("name", MIN_SCORES)
def test_scores_reach_their_targets(metrics, name):
    assert metrics[name] >= MIN_SCORES[name]


def test_sessions_are_long_enough_for_windows(toy):
    """A window has 8 + 56 frames."""
    for video in json.loads((toy / "plan" / "videos.json").read_text()):
        if video["role"] == "session":
            assert len(list((toy / "frames" / video["id"] / "color").iterdir())) >= 90


def test_a_second_make_runs_no_stage(toy):
    again = subprocess.run(["make", "toy"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "begins" not in again.stderr
    assert "build/toy/report/index.html" in again.stdout


def test_snakemake_finds_it_up_to_date(toy):
    command = [".venv/bin/python", "-m", "snakemake", "--cores", "2", "--config", "agent=toy"]
    completed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert "Nothing to be done" in completed.stdout + completed.stderr, completed.stderr
