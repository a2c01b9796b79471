"""The doctor looks at everything it says it does, and fails only for what every build needs."""

from pipeline.workflow import doctor


def test_a_machine_that_runs_these_tests_is_fit(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "LIBRARIES", ("numpy", "torch"))
    assert doctor.main() == 0
    told = capsys.readouterr().out
    assert [line.split()[1] for line in told.splitlines()] == [
        "python",
        "libraries",
        "OpenGL",
        "pymeshlab",
        "processors",
        "lock",
        "memory",
        "disk",
        "browser",
        "recordings",
    ]


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setattr(doctor, "LIBRARIES", ("no_such_library",))
    finding = doctor.libraries()
    assert finding.state == "fail"
    assert "no_such_library" in finding.text
