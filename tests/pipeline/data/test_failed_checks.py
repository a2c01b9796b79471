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
