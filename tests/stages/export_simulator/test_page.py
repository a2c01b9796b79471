"""The page in headless Chromium, from a file: it lives, asks nobody, samples as Python does, minds the observer."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline import artifact
from pipeline.cli import Task
from stages.export_simulator.__main__ import Config, run
from tests.stages.export_simulator import browser, small_world

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
        page.wait_for_function(f"ats.state().tick > {before['tick'] + 5}", timeout=30_000)
        after = page.evaluate("ats.state()")
        assert np.linalg.norm(np.subtract(after["animal"], before["animal"])[:3]) > 0.01, "metres within half a second"
        assert wrong == []


def _check_golden(golden: dict, sampled: dict) -> None:
    for name, plan in golden["plans"].items():
        for level, expected in plan.items():
            expected, found = np.array(expected), np.array(sampled[name][level])
            assert np.abs(found - expected).max() <= 1e-3 * expected.std(), f"{name} {level}"


def _check_reaction(page: browser.Page) -> None:
    state = page.evaluate("ats.state()")
    here = np.array(state["animal"])[[0, 2]]
    side = np.array([0.8, 0.6])

    def goals(place: np.ndarray, **more: object) -> np.ndarray:
        question = {"observer": place.tolist(), "seed": 7, "K": 16, **more}
        return np.array(page.evaluate("question => ats.sampleGoals(question)", question))[:, [0, 2]]

    far, near, opposite = goals(here + 9 * side), goals(here + 0.5 * side), goals(here - 0.5 * side)
    unaware = goals(here + 0.5 * side, interactivity=0)
    assert np.abs(goals(here - 9 * side) - far).max() < 1e-5, "a far observer does not matter"
    assert np.abs(unaware - far).max() < 1e-5, "nor one it is told to ignore"
    assert (near - far).mean(0) @ side < -0.3, "metres: away from who is near"
    assert (opposite - far).mean(0) @ side > 0.3, "and the other way when approached from there"


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
