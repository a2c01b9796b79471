import json
import math

import pytest

from pipeline.data import qa


def test_failed_checks_of_an_artifact_are_named(tmp_path):
    assert qa.failures(tmp_path) == []
    checks = [
        qa.Check("frames", 30.0, warn=10.0, better="higher"),
        qa.Check("blur", 3.0, warn=2.0, fail=5.0),
        qa.Check("pictures against depth (9 of 9 pairs agree better with mirrored depth)", 1.0, fail=0.5),
    ]
    qa.write(tmp_path, good="", bad="", checks=checks)
    assert qa.failures(tmp_path) == [checks[2].name]


@pytest.mark.parametrize(
    "limits", [{"warn": math.nan}, {"fail": math.nan}, {"warn": 2.0, "fail": math.nan}, {"warn": math.inf}]
)
def test_a_limit_that_was_not_measured_warns(tmp_path, limits):
    for better in ("lower", "higher"):
        check = qa.Check("length", 1.0, "m", **limits, better=better)
        assert check.status == "warn"
    qa.write(tmp_path, good="", bad="", checks=[check])
    (written,) = json.loads((tmp_path / "qa.json").read_text())["checks"]
    assert {written[key] for key in ("warn", "fail")} <= {None, 2.0} and written["status"] == "warn"


def test_an_artifact_without_checks_has_no_status(tmp_path):
    qa.write(tmp_path, good="", bad="")
    assert json.loads((tmp_path / "qa.json").read_text())["status"] == "none"
    qa.write(tmp_path, good="", bad="", checks=[qa.Check("frames", 3.0)])
    assert json.loads((tmp_path / "qa.json").read_text())["status"] == "ok"
