"""Furniture is dragged on the page, and animal and person avoid its new position."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from tests.stages.export_simulator import browser, small_world

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path(browser.CHROMIUM).exists(), reason="Chromium is not installed"),
]
SHAPE, CORNER_M, VOXEL_M = (44, 24, 44), -2.2, 0.1
TOP = [0.0, 0.8, 0.0]
PLAN = "([aim, seed]) => ats.plan({ aim, seed, samples: 1 }).then(({ path }) => path)"
HEAD = "ats.contract.agent.standing_m"


@pytest.fixture(scope="module")
def furnished(simulator: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export the small world with a box in the middle of its room."""
    build = tmp_path_factory.mktemp("furnished")
    for name in small_world.READS:
        shutil.copytree(simulator.parent / name, build / name)
    small_world.furnish(build)
    return small_world.exported(build, build / "simulator") / "index.html"


def test_furniture_is_dragged_undone_and_refused(furnished: Path, chromium: Browser) -> None:
    with browser.shown(chromium, furnished.as_uri(), size=(900, 760)) as (page, wrong):
        page.evaluate("ats.pause(); ats.moveObserver([-1.7, -1.7])")
        before = page.evaluate("ats.furniture()")
        (box,) = before["pieces"]
        assert box["cells"] == 6 * 8 * 4
        page.keyboard.press("m")
        assert page.get_attribute("#move", "aria-pressed") == "true"
        by = _free_place(page)
        _dragged(page, by)
        after = page.evaluate("ats.furniture()")
        assert after["pieces"][0]["by"] == by
        _check_it_has_moved(before, after, by)
        assert "moved=" in page.evaluate("location.hash") and page.is_visible("#restore")
        _check_the_link(page, after)
        page.keyboard.press("z")
        assert page.evaluate("ats.furniture()") == before, "every voxel, mark and triangle"
        assert "moved=" not in page.evaluate("location.hash") and not page.is_visible("#undo")
        page.keyboard.press("m")
        _check_refusals(page, before)
        assert wrong == []


def _free_place(page: Page) -> list[int]:
    """Return a move of the box, voxels, to a side where the animal is not."""
    x, _, z = page.evaluate("ats.state().animal")[:3]
    return [-9 if x > 0 else 9, 2 if z < 0 else -2]


def _dragged(page: Page, by: list[int]) -> None:
    end = [TOP[0] + VOXEL_M * by[0], TOP[1], TOP[2] + VOXEL_M * by[1]]
    page.mouse.move(*page.evaluate("p => ats.screen(p)", TOP))
    page.mouse.down()
    page.mouse.move(*page.evaluate("p => ats.screen(p)", end), steps=4)
    assert page.evaluate("ats.furniture().held") == {"by": by}
    page.mouse.up()


def _check_it_has_moved(before: Any, after: Any, by: list[int]) -> None:
    """The occupancy is shifted with the voxels of the box; triangles are split without loss."""
    old, new = (np.reshape(state["occupancy"], SHAPE) == 1 for state in (before, after))
    box = np.zeros(SHAPE, bool)
    box[19:25, 2:10, 20:24] = True
    assert old[box].all() and new.sum() == old.sum()
    np.testing.assert_array_equal(new, (old & ~box) | np.roll(box, by, (0, 2)))
    assert 0 < after["triangles"] < before["triangles"]


def _check_the_link(page: Page, after: Any) -> None:
    page.reload()
    page.wait_for_function(browser.READY, timeout=60_000)
    page.evaluate("ats.pause(); ats.moveObserver([-1.7, -1.7])")
    assert page.evaluate("ats.furniture()") == after, "the link restores it"
    page.evaluate("location.hash = '#moved=1.5,1.5,1.5,0.3,0'")
    page.wait_for_function("document.querySelector('#help').textContent.includes('moved=1 of')")
    assert page.evaluate("ats.furniture().pieces[0].by") == [0, 0]
    page.evaluate("ats.moveObserver([-1.7, -1.7])")
    page.keyboard.press("m")
    _dragged(page, after["pieces"][0]["by"])


def _check_refusals(page: Page, before: Any) -> None:
    """Walls cannot be picked up; nothing can be placed on a wall or the animal."""
    page.keyboard.press("m")
    page.mouse.click(*page.evaluate("ats.screen([-1.99, 1.2, -0.8])"))
    assert "wall" in page.inner_text("#help")
    x, _, z = page.evaluate("ats.state().animal")[:3]
    for by, word in (
        ([-20, 0], "Something else"),
        ([round(x / VOXEL_M), round(z / VOXEL_M)], "tube is in the way"),
    ):
        _dragged(page, by)
        assert word in page.inner_text("#help")
        assert page.evaluate("ats.furniture()") == before
    page.locator("#view").press("Enter")
    page.keyboard.press("ArrowUp")
    assert page.evaluate("Math.hypot(...ats.furniture().held.by)") == 1, "one voxel"
    page.keyboard.press("Escape")
    assert page.evaluate("ats.furniture()") == before
    _check_a_tool_put_away_while_dragging(page, before)


def _check_a_tool_put_away_while_dragging(page: Page, before: Any) -> None:
    """The piece goes back, the rest of the drag does nothing, and the view can be turned again."""
    page.keyboard.press("m")
    page.mouse.move(*page.evaluate("p => ats.screen(p)", TOP))
    page.mouse.down()
    page.mouse.move(*page.evaluate("p => ats.screen(p)", [TOP[0] - 0.5, *TOP[1:]]), steps=3)
    assert page.evaluate("ats.furniture().held") is not None
    page.keyboard.press("Escape")
    page.mouse.move(*page.evaluate("p => ats.screen(p)", [TOP[0] - 0.9, *TOP[1:]]), steps=3)
    page.mouse.up()
    assert page.evaluate("ats.furniture()") == before


def test_animal_and_person_walk_around_moved_furniture(furnished: Path, chromium: Browser) -> None:
    with browser.shown(chromium, furnished.as_uri(), size=(900, 760)) as (page, wrong):
        page.evaluate("ats.pause(); ats.moveObserver([-1.7, -1.7])")
        here = np.array(page.evaluate("ats.state().animal"))[[0, 2]]
        by = [round(value) for value in (here + _towards_the_free_side(here)) / VOXEL_M]
        stands = _columns(by)
        goal = here + 2 * _towards_the_free_side(here)
        aim = [goal[0], page.evaluate(HEAD), goal[1]]
        free = [_planned(page, here, aim, seed) for seed in range(6)]
        assert sum(_entered(path, stands) for path in free) >= 4, "straight through where it will be"
        page.keyboard.press("m")
        _dragged(page, by)
        assert page.evaluate("ats.furniture().pieces[0].by") == by
        for seed in range(6):
            path = _planned(page, here, aim, seed)
            assert not _entered(path, stands), seed
            assert np.linalg.norm(path[-1] - goal) < 0.5 * np.linalg.norm(here - goal), "meters: it gets past"
        _check_it_walks_around(page, stands, goal)
        _check_the_person_does(page, by)
        assert wrong == []


def _towards_the_free_side(here: np.ndarray) -> np.ndarray:
    """Return a step of 1.1 m along the wall, for an animal that walks 1.2 m from the center."""
    aside = np.array([-here[1], here[0]]) - 0.55 * here
    return 1.1 * aside / np.linalg.norm(aside)


def _columns(by: list[int]) -> np.ndarray:
    box = np.zeros((SHAPE[0], SHAPE[2]), bool)
    box[19:25, 20:24] = True
    return np.roll(box, by, (0, 1))


def _planned(page: Page, here: np.ndarray, aim: list[float], seed: int) -> np.ndarray:
    path = np.array(page.evaluate(PLAN, [aim, seed]))[:, [0, 2]]
    return np.concatenate([here[None], path])


def _entered(path: np.ndarray, columns: np.ndarray) -> bool:
    share = np.linspace(0, 1, 10, endpoint=False)[:, None, None]
    dense = (path[:-1] * (1 - share) + path[1:] * share).reshape(-1, 2)
    at = np.floor((dense - CORNER_M) / VOXEL_M + 1e-6).astype(int)
    return bool(columns[at[:, 0], at[:, 1]].any())


def _check_it_walks_around(page: Page, stands: np.ndarray, goal: np.ndarray) -> None:
    page.evaluate("goal => { ats.visit([goal]); ats.play(); }", goal.tolist())
    way = []
    for state in browser.states(page, 300):
        way.append(np.array(state["animal"])[[0, 2]])
        if state["aim"] is None:
            break
    else:
        pytest.fail(f"half a minute, and it stands at {way[-1]}")
    page.evaluate("ats.pause()")
    assert not any(_entered(np.stack([place, place]), stands) for place in way)


def _check_the_person_does(page: Page, by: list[int]) -> None:
    """Pulled to the other side of the box, the person stays on this side or walks around."""
    middle = VOXEL_M * np.array(by)
    from_here = middle - np.array([0.8, 0])
    page.keyboard.press("m")
    page.evaluate("place => ats.moveObserver(place)", from_here.tolist())
    page.evaluate("ats.play()")
    page.wait_for_timeout(300)  # the figure is moved when a frame is drawn
    page.mouse.move(*page.evaluate("([x, z]) => ats.screen([x, 0.8, z])", from_here.tolist()))
    page.mouse.down()
    page.mouse.move(*page.evaluate("([x, z]) => ats.screen([x + 0.8, 0, z])", middle.tolist()), steps=3)
    for state in browser.states(page, 11):
        place = np.array(state["observer"])
        assert not _entered(np.stack([place, place]), _columns(by))
    page.mouse.up()
    assert np.linalg.norm(place - from_here) > 0.2, "meters: it came as far as the box"


def test_furniture_is_dragged_by_touch(furnished: Path, chromium: Browser) -> None:
    size = (390, 844)
    with browser.shown(chromium, furnished.as_uri(), size=size, has_touch=True, is_mobile=True) as (
        page,
        wrong,
    ):
        page.evaluate("ats.pause(); ats.moveObserver([-1.7, -1.7])")
        by = _free_place(page)
        end = [VOXEL_M * by[0], TOP[1], VOXEL_M * by[1]]
        page.tap("#move")
        touch = page.context.new_cdp_session(page)
        places = [page.evaluate("p => ats.screen(p)", point) for point in (TOP, end)]
        for kind, place in (("touchStart", places[0]), ("touchMove", places[1]), ("touchEnd", None)):
            points = [{"x": place[0], "y": place[1], "id": 0}] if place else []
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        assert page.evaluate("ats.furniture().pieces[0].by") == by
        assert wrong == []


def test_moved_furniture_applies_to_all_animals(tmp_path: Path, chromium: Browser) -> None:
    small_world.write_home(tmp_path)
    for name in ("cat", "dog"):
        small_world.furnish(tmp_path / name)
    home = small_world.exported_home(tmp_path, tmp_path / "page")
    address = (home / "index.html").as_uri() + "#moved=0.05,0.45,0.05,0.2,-0.1"
    with browser.shown(chromium, address) as (page, wrong):
        page.evaluate("ats.pause()")
        for name in ("cat", "dog"):
            page.evaluate("name => ats.select(name)", name)
            state = page.evaluate("ats.furniture()")
            solid = np.reshape(state["occupancy"], SHAPE)[:, 5] == 1
            np.testing.assert_array_equal(solid[2:-2, 2:-2], _columns([2, -1])[2:-2, 2:-2])
        assert wrong == []
