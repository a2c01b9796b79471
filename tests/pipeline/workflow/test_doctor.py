"""The doctor runs all its checks and fails only for requirements of every build."""

import os
import subprocess
from pathlib import Path

import pytest

from pipeline.workflow import doctor

ROOT = Path(__file__).parents[3]


def test_this_machine_passes(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "LIBRARIES", ("numpy", "torch"))
    assert doctor.main() == 0
    output = capsys.readouterr().out
    assert [line.split()[1] for line in output.splitlines()] == [
        "python",
        "libraries",
        "pymeshlab",
        "processors",
        "lock",
        "memory",
        "disk",
        "browser",
        "recordings",
    ]


def test_missing_library_is_named(monkeypatch):
    monkeypatch.setattr(doctor, "LIBRARIES", ("no_such_library",))
    finding = doctor.libraries()
    assert finding.state == "fail"
    assert "no_such_library" in finding.text


@pytest.mark.parametrize(
    ("kind", "gpu", "state"),
    [("cpu", False, "ok"), ("cpu", True, "warn"), ("cuda", False, "ok"), ("cuda", True, "ok")],
)
def test_unsuitable_lock_is_named(tmp_path, monkeypatch, kind, gpu, state):
    monkeypatch.chdir(tmp_path)
    assert doctor.lock().state == "warn", "no environment of envs/setup"
    (tmp_path / ".venv").mkdir()
    (tmp_path / ".venv/lock").write_text(f"{kind}\n")
    monkeypatch.setattr(doctor.shutil, "which", lambda name: "/usr/bin/nvidia-smi" if gpu else None)
    assert (doctor.lock().state, f"envs/{kind}.txt" in doctor.lock().text) == (state, True)
    assert ("LOCK=cuda" in doctor.lock().text) == (state == "warn")


def test_unknown_lock_is_refused():
    refused = subprocess.run([ROOT / "envs/setup", "metal"], capture_output=True, text=True)
    assert refused.returncode == 2
    assert "ENV-002 LOCK=metal" in refused.stderr


@pytest.mark.parametrize(
    ("cores", "memory_mb", "jobs"), [(8, 8000, 2), (8, 64000, 8), (2, 2000, 1), (4, 0, 4)]
)
def test_parallel_jobs_are_limited_by_memory(tmp_path, cores, memory_mb, jobs):
    pages = memory_mb * 1024 // 4
    for name, text in {
        "nproc": f"echo {cores}",
        "getconf": f"case $1 in PAGESIZE) echo 4096;; *) echo {pages};; esac",
        "cat": "exit 1",
    }.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    path = f"{tmp_path}:{os.environ['PATH']}"
    found = subprocess.run(
        [ROOT / "envs/parallel_jobs"], env={"PATH": path}, capture_output=True, text=True, check=True
    )
    assert int(found.stdout) == jobs
