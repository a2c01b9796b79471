"""Shared fixtures: a page of the small world and a browser."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from tests.stages.export_simulator import browser, small_world


@pytest.fixture(scope="session")
def simulator(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export a small world, as one file and as a folder."""
    raw, build = tmp_path_factory.mktemp("raw"), tmp_path_factory.mktemp("build")
    small_world.write(raw)
    shutil.copytree(raw, build, dirs_exist_ok=True)
    small_world.exported(raw, build / "light", replace(small_world.NAMED, layout="folder"))
    shutil.copy(raw / "behavior/golden.json", build / "golden.json")
    return small_world.exported(raw, build / "simulator")


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    with browser.chromium() as opened:
        yield opened
