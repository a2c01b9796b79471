"""The page in headless Chromium, from a file: it lives, asks nobody, samples as Python does, minds the observer."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page

from pipeline import artifact
from pipeline.cli import Task
from stages.export_simulator.__main__ import Config, run
from tests.stages.export_simulator import browser, reaction, small_world

pytestmark = pytest.mark.skipif(not Path(browser.CHROMIUM).exists(), reason="Chromium is not installed")
READS = ("reconstruction", "splats", "behavior", "behavior_data")


@pytest.fixture(scope="module")
def simulator(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export a small world."""
    raw, build = tmp_path_factory.mktemp("raw"), tmp_path_factory.mktemp("build")
    small_world.write(raw)
    for name in READS:
        with artifact.create(build / name, stage=name, config={}, inputs={}) as folder:
            shutil.copytree(raw / name, folder, dirs_exist_ok=True)
    paths = {name: build / name for name in READS}
    run(Task("export_simulator", Config(name="tube"), build / "simulator", None, (), None, 1, None, paths, "cpu"))
    shutil.copy(raw / "behavior/golden.json", build / "golden.json")
    return build / "simulator"


def test_page_lives_and_minds_the_observer(simulator: Path) -> None:
    golden = json.loads((simulator.parent / "golden.json").read_bytes())
    with browser.opened(simulator / "index.html") as (page, wrong):
        before = page.evaluate("ats.state()")
        _check_golden(golden, page.evaluate("golden => ats.golden(golden)", golden))
        page.evaluate("ats.pause()")
        _check_reaction(page)
        page.evaluate("ats.play()")
        _check_hands(page)
        page.wait_for_function(f"ats.state().tick > {before['tick'] + 5}", timeout=30_000)
        after = page.evaluate("ats.state()")
        assert np.linalg.norm(np.subtract(after["animal"], before["animal"])[:3]) > 0.01, "metres within half a second"
        assert wrong == []


def _check_golden(golden: dict, sampled: dict) -> None:
    for name, plan in golden["plans"].items():
        for level, expected in plan.items():
            expected, found = np.array(expected), np.array(sampled[name][level])
            assert np.abs(found - expected).max() <= 1e-3 * expected.std(), f"{name} {level}"


def _check_hands(page: Page) -> None:
    """Click the floor for a goal; drag the person somewhere else."""
    page.mouse.click(*page.evaluate("ats.screen([-1.2, 0, -1.0])"))
    assert np.allclose(page.evaluate("ats.state().aim"), [-1.2, -1.0], atol=0.05), "metres"
    assert "aim=" in page.evaluate("location.hash")
    page.evaluate("ats.moveObserver([1.0, 0.5])")
    page.wait_for_timeout(500)
    page.mouse.move(*page.evaluate("ats.screen([1.0, 0.8, 0.5])"))
    page.mouse.down()
    page.mouse.move(*page.evaluate("ats.screen([-0.2, 0, 1.2])"), steps=5)
    page.wait_for_timeout(1500)
    page.mouse.up()
    assert np.allclose(page.evaluate("ats.state().observer"), [-0.2, 1.2], atol=0.1), "metres"


def _check_reaction(page: Page) -> None:
    here = np.array(page.evaluate("ats.state()")["animal"])[[0, 2]]
    side = np.array([0.8, 0.6])
    far = reaction.goals(page, here + 9 * side)
    assert np.abs(reaction.goals(page, here - 9 * side) - far).max() < 1e-5, "a far observer does not matter"
    unaware = reaction.goals(page, here + 0.5 * side, interactivity=0)
    assert np.abs(unaware - far).max() < 1e-5, "nor one it is told to ignore"
    assert (reaction.away_m(page, directions=4) > 0.3).all(), "metres: away from who comes near, whichever way"


def test_hash_keeps_a_setting(simulator: Path) -> None:
    with browser.opened(simulator / "index.html", "#interactivity=0.25&samples=16&steps=50&scene=0&aim=0.5,0.5") as (
        page,
        wrong,
    ):
        settings = page.evaluate("ats.state().settings")
        assert (settings["interactivity"], settings["samples"], settings["steps"], settings["scene"]) == (
            0.25,
            16,
            50,
            0,
        )
        assert page.evaluate("ats.state().aim") == [0.5, 0.5]
        assert page.input_value("#interactivity") == "0.25"
        assert wrong == []
