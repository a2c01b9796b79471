"""`pip install .` contains all files of the stages, and their programs work outside the checkout."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
ASSETS = (
    "pipeline/workflow/help.txt",
    "stages/annotate/page.html",
    "stages/export_simulator/web/dist/page.html",
    "stages/report/templates/index.html",
)


@pytest.mark.slow
def test_wheel_runs_outside_the_checkout(tmp_path):
    target = tmp_path / "installed"
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target", str(target)]
    source = tmp_path / "source"
    for name in ("pipeline", "stages"):
        shutil.copytree(
            ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__", "node_modules")
        )
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, source)
    subprocess.run([sys.executable, "-m", "pip", "install", *options, str(source)], check=True)
    assert not [name for name in ASSETS if not (target / name).is_file()]
    command = [sys.executable, "-m", "stages.estimate_flow", "--help"]
    installed = os.environ | {"PYTHONPATH": str(target)}
    called = subprocess.run(command, cwd=tmp_path, env=installed, capture_output=True, text=True)
    assert called.returncode == 0, called.stderr
    assert "working_side_px = 1280" in called.stdout


def test_versions_of_package_citation_and_changelog_agree():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    headings = [line for line in (ROOT / "CHANGELOG.md").read_text().splitlines() if line.startswith("## ")]
    assert headings[0] in (f"## {version}", "## Unreleased")
