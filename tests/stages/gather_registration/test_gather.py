"""Gathering: the summary names what was registered and why the rest was not, the picture survives gaps."""

import numpy as np

from stages.gather_registration import gather

STATUS = {"registered": True, "reason": None, "figures": {"depth_gap_m": 0.01, "confidence": 0.9}}
REFUSED = {"registered": False, "reason": "no overlap", "figures": {}}


def test_summary_and_checks():
    poses = {name: np.repeat(np.eye(4)[None], 5, axis=0) for name in ("world_from_camera", "world_from_agent")}
    poses["world_from_agent"][2] = np.nan
    outcomes = [gather.Outcome("v002", STATUS, poses), gather.Outcome("v003", REFUSED, None)]
    summary = gather.summarise(outcomes)
    assert (summary["registered"], summary["total"]) == (1, 2)
    assert summary["videos"]["v003"]["reason"] == "no overlap"
    assert {check.name: check.value for check in gather.checks(outcomes)}["recordings registered"] == 0.5
    assert gather.paths(outcomes).shape == (560, 560, 3)


def test_a_gap_that_was_not_measured_does_not_count():
    measured = gather.Outcome("v002", STATUS, {})
    unmeasured = gather.Outcome("v003", {**STATUS, "figures": {"depth_gap_m": None, "confidence": 0.9}}, {})
    assert [gather.checks(outcomes)[1].value for outcomes in ([measured, unmeasured], [unmeasured])] == [1.0, None]


def test_nothing_registered_is_told_without_a_fault():
    outcomes = [gather.Outcome("v002", REFUSED, None)]
    assert gather.checks(outcomes)[0].status == "fail"
    assert gather.paths(outcomes).shape == (560, 560, 3)


def test_a_refusal_is_told_by_name_with_its_nearest_view():
    refused = gather.Outcome("v003", {**REFUSED, "nearest_view": {"walkthrough_s": 12.34}}, None, "b.r3d")
    assert refused.told == "b.r3d: no overlap; its nearest view is the walk-through at 12.3 s"
    assert gather.summarise([refused])["videos"]["v003"]["file"] == "b.r3d"
