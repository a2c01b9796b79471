"""The committed bundle is up to date with its sources."""

import gzip
import hashlib
import json
import shutil
import subprocess
from pathlib import Path

import pytest

WEB = Path(__file__).parents[3] / "stages/export_simulator/web"


def test_bundle_is_newer_than_its_sources() -> None:
    made_of = json.loads((WEB / "dist/sources.json").read_bytes())
    files = ["build.mjs", "package-lock.json", *(f"src/{path.name}" for path in (WEB / "src").iterdir())]
    now = {name: hashlib.sha256((WEB / name).read_bytes()).hexdigest() for name in files}
    assert now == made_of, "run `npm ci && npm run build` in stages/export_simulator/web"


@pytest.mark.skipif(
    shutil.which("node") is None or not (WEB / "node_modules").is_dir(),
    reason="needs node, and `npm ci` in stages/export_simulator/web",
)
def test_rebuilt_bundle_is_identical(tmp_path: Path) -> None:
    subprocess.run(["node", "build.mjs", str(tmp_path)], cwd=WEB, check=True)
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in (WEB / "dist").iterdir()}
    for path in tmp_path.iterdir():
        assert _plain(path) == _plain(WEB / "dist" / path.name), path.name


def _plain(path: Path) -> bytes:
    return gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
