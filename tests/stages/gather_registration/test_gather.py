"""Summary of registration: registered and rejected recordings with reasons, and a picture with gaps."""

import json

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.data.poses import RegisteredPoses
from stages.gather_registration import stage
from stages.gather_registration.config import Config

STATUS = {"registered": True, "reason": None, "figures": {"depth_gap_m": 0.01, "confidence": 0.9}}
REFUSED = {"registered": False, "reason": "no overlap", "figures": {}}


def _poses() -> RegisteredPoses:
    camera = np.repeat(np.eye(4)[None], 5, axis=0)
    agent = np.repeat(np.eye(4)[None], 5, axis=0)
    ones = np.ones(5)
    agent[2] = np.nan
    return RegisteredPoses(np.arange(5.0), camera, agent, ones, ones, ones > 0)


def test_summary_has_counts_and_checks():
    poses = _poses()
    outcomes = [stage.SessionOutcome("v002", STATUS, poses), stage.SessionOutcome("v003", REFUSED, None)]
    summary = stage.summarize(outcomes)
    assert (summary["registered"], summary["total"]) == (1, 2)
    assert summary["videos"]["v003"]["reason"] == "no overlap"
    assert {check.name: check.value for check in stage.checks(outcomes)}["recordings registered"] == 0.5
    assert stage.paths(outcomes).shape == (560, 560, 3)


def test_unmeasured_gaps_are_ignored():
    measured = stage.SessionOutcome("v002", STATUS, _poses())
    unmeasured = stage.SessionOutcome(
        "v003", {**STATUS, "figures": {"depth_gap_m": None, "confidence": 0.9}}, _poses()
    )

    def gaps(outcomes):
        return [check.value for check in stage.checks(outcomes) if "depth" in check.name]

    assert (gaps([measured, unmeasured]), gaps([unmeasured])) == ([1.0], [])


def test_no_registered_recording_is_reported():
    outcomes = [stage.SessionOutcome("v002", REFUSED, None)]
    assert stage.checks(outcomes)[0].status == "fail"
    assert stage.paths(outcomes).shape == (560, 560, 3)


def test_rejection_is_reported_with_its_nearest_view():
    refused = stage.SessionOutcome(
        "v003", {**REFUSED, "nearest_view": {"walkthrough_s": 12.34}}, None, "b.r3d"
    )
    assert refused.description == "b.r3d: no overlap; its nearest view is the walk-through at 12.3 s"
    assert stage.summarize([refused])["videos"]["v003"]["file"] == "b.r3d"


def test_stage_copies_poses_and_fails_if_too_few_are_registered(tmp_path):
    folders = {}
    for name, status in (("v002", STATUS), ("v003", REFUSED)):
        folders[name] = tmp_path / name
        folders[name].mkdir()
        (folders[name] / "status.json").write_text(json.dumps({**status, "figures": status["figures"]}))
    eye = np.repeat(np.eye(4)[None], 3, axis=0)
    ones = np.ones(3)
    RegisteredPoses(np.arange(3.0), eye, eye, ones, ones, ones > 0).write(folders["v002"])
    out = tmp_path / "out"
    out.mkdir()
    summary = stage.run(stage.Inputs(folders), Config(), out)
    assert summary["registered"] == 1
    assert (RegisteredPoses.open(out / "v002").world_from_camera == eye).all()
    assert not (out / "v003").exists()
    with pytest.raises(InputError, match="REG-001.*no overlap"):
        stage.run(stage.Inputs(folders), Config(min_registered=2), out)
