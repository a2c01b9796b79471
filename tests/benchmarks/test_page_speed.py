"""The benchmark of pages finds those of one animal and those of a home."""

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import page_speed


@pytest.mark.parametrize("name", page_speed.PAGES)
def test_page_of_an_animal_or_of_a_home_is_found(tmp_path, name):
    with pytest.raises(SystemExit, match="home_simulator/index.html"):
        page_speed.page_of(tmp_path)
    (tmp_path / name).parent.mkdir()
    (tmp_path / name).touch()
    assert page_speed.page_of(tmp_path) == tmp_path / name


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs Linux")
def test_cpu_time_is_that_of_processes_of_processes():
    before = page_speed.browser_cpu_s()
    work = "sum(range(30_000_000)); print(1, flush=True); input()"
    inner = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {work!r}])"
    outer = [sys.executable, "-c", inner]
    with subprocess.Popen(outer, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"1\n"
        assert page_speed.browser_cpu_s() - before > 0.1, "seconds"
        process.communicate(b"\n")
