"""The page on small windows, touch screens, screen readers and headsets."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, CDPSession, Page

from tests.stages.export_simulator import browser

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path(browser.CHROMIUM).exists(), reason="Chromium is not installed"),
]
PARTS = ("#panel-toggle", "#panel-body", "#player", "#help", "#map", "#title")
SIZES = (
    (1280, 720),
    (1000, 640),
    (900, 760),
    (900, 600),
    (768, 1024),
    (390, 844),
    (844, 390),
    (640, 480),
    (320, 568),
)
NAMELESS = """[...document.querySelectorAll('button, input, select, canvas, [role=group]')].filter((part) => {
  const label = part.getAttribute('aria-label') ?? part.labels?.[0]?.textContent ?? part.textContent;
  return !/[\\p{L}\\d]/u.test(label);
}).map((part) => part.outerHTML)"""
HEADSET = Path(__file__).with_name("headset.js").read_text()


def test_controls_do_not_overlap(simulator: Path, chromium: Browser) -> None:
    """With the panel open and closed, at many window sizes, controls neither overlap nor are cut off."""
    with browser.shown(chromium, (simulator / "index.html").as_uri(), size=(1280, 720)) as (page, _):
        page.evaluate("ats.pause(); ats.visit([[0, 0]])")
        page.evaluate("for (const id of ['undo', 'restore']) document.getElementById(id).hidden = false")
        for (width, height), folded in itertools.product(SIZES, (False, True)):
            page.set_viewport_size({"width": width, "height": height})
            _fold(page, folded)
            boxes = {part: box for part in PARTS if (box := page.locator(part).bounding_box())}
            assert {"#player", "#title", "#panel-toggle"} < set(boxes)
            for part, box in boxes.items():
                assert box["x"] >= 0 and box["x"] + box["width"] <= width, (width, height, folded, part)
                assert box["y"] >= 0 and box["y"] + box["height"] <= height, (width, height, folded, part)
            for first, second in itertools.combinations(boxes, 2):
                assert _apart(boxes[first], boxes[second]), (width, height, folded, first, second)


def test_goal_does_not_move_the_buttons(simulator: Path, chromium: Browser) -> None:
    with browser.shown(chromium, (simulator / "index.html").as_uri(), size=(1280, 720)) as (page, _):
        page.evaluate("ats.pause()")
        heights = []
        for goals in ("[]", "[[0, 0]]"):
            page.evaluate(f"ats.visit({goals})")
            heights.append(page.locator("#player").bounding_box()["height"])
        assert heights[0] == heights[1], "pixels: one row"


def _fold(page: Page, folded: bool) -> None:
    if page.is_visible("#panel-body") == folded:
        page.click("#panel-toggle")
    assert page.is_visible("#panel-body") != folded
    assert page.get_attribute("#panel-toggle", "aria-expanded") == str(not folded).lower()


def _apart(a: Any, b: Any) -> bool:
    beside = a["x"] + a["width"] <= b["x"] or b["x"] + b["width"] <= a["x"]
    return beside or a["y"] + a["height"] <= b["y"] or b["y"] + b["height"] <= a["y"]


def test_small_windows_have_a_closed_panel_and_touch_input(simulator: Path, chromium: Browser) -> None:
    """One finger rotates the view, two pan it, a tap sets a goal; the help describes touch input."""
    address = (simulator / "index.html").as_uri()
    with browser.shown(chromium, address, size=(390, 844), has_touch=True, is_mobile=True) as (page, wrong):
        assert not page.is_visible("#panel-body")
        page.evaluate("ats.pause()")
        touch = page.context.new_cdp_session(page)
        floor = [np.array(page.evaluate("p => ats.screen(p)", [x, 0, 0])) for x in (-0.5, 0.9)]
        start = np.array([page.evaluate("ats.state().eye"), page.evaluate("ats.target()")])
        _dragged(touch, [floor[0]], [90.0, 0.0])
        turned = _at_rest(page)
        assert np.linalg.norm(turned[0] - start[0]) > 0.5, "meters: the eye went around"
        assert np.allclose(turned[1], start[1], atol=0.02), "meters: what it looks at stayed"
        _dragged(touch, floor, [60.0, 30.0])
        moved = _at_rest(page)
        shift = moved - turned
        assert np.linalg.norm(shift[1]) > 0.2, "meters: what is looked at moved, and the eye with it"
        assert page.evaluate("ats.state().aim") is None
        page.touchscreen.tap(195, 420)
        goal = page.evaluate(
            "ats.screen([ats.state().aim[0], ats.contract.scene.floor_m, ats.state().aim[1]])"
        )
        assert np.allclose(goal, [195, 420], atol=2), "pixels"
        page.tap("#how")
        assert "two move and zoom" in page.inner_text("#help")
        assert wrong == []


def _dragged(touch: CDPSession, fingers: list[np.ndarray], way: list[float]) -> None:
    """Touch at positions (pixels), move by a displacement, and release."""
    for share in np.linspace(0, 1, 6):
        points = [
            {"x": float(x), "y": float(y), "id": i}
            for i, (x, y) in enumerate(place + share * np.array(way) for place in fingers)
        ]
        kind = "touchStart" if share == 0 else "touchMove"
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})


def _at_rest(page: Page) -> np.ndarray:
    """Return eye and target in meters once the view has settled."""
    page.wait_for_function(
        """() => {
          const [now, before] = [ats.state().eye, window.eyeBefore];
          window.eyeBefore = now;
          return before && Math.hypot(...now.map((value, i) => value - before[i])) < 1e-3;
        }""",
        polling=250,
        timeout=20_000,
    )
    return np.array([page.evaluate("ats.state().eye"), page.evaluate("ats.target()")])


def test_page_is_accessible_to_screen_readers(simulator: Path, chromium: Browser) -> None:
    """Controls have names; position and arrival of the animal are announced."""
    with browser.shown(chromium, (simulator / "index.html").as_uri()) as (page, wrong):
        assert page.evaluate(NAMELESS) == []
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.id") == "view"
        assert page.evaluate("getComputedStyle(view).outlineStyle") == "solid", "one sees where the focus is"
        page.locator("#view").press("l")
        x, _, z = page.evaluate("ats.state().animal")[:3]
        distance = np.hypot(*np.subtract([x, z], page.evaluate("ats.state().observer")))
        said = page.inner_text("#spoken")
        assert said.startswith("tube is ") and abs(float(said.split()[2]) - distance) < 0.3, "meters"
        page.evaluate("([x, z]) => ats.visit([[x + 0.3, z]])", [x, z])
        page.wait_for_function(
            "document.querySelector('#spoken').textContent.includes('arrived')", timeout=60_000
        )
        assert not page.is_visible("#headset"), "this browser has none"
        assert wrong == []


def test_headset_controls_the_person(simulator: Path, chromium: Browser) -> None:
    """The head is the person, a stick walks, a controller sets goals; the view is restored afterwards."""
    address = (simulator / "index.html").as_uri()
    with browser.shown(chromium, address, script=HEADSET) as (page, wrong):
        before = page.evaluate("ats.state()")
        page.evaluate("headset.refuses = true")
        page.click("#headset")
        page.wait_for_function("document.querySelector('#help').textContent.includes('no floor')")
        assert page.evaluate("headset.session.ended"), "nobody is left in an empty headset"
        _frames(page, 2)
        assert np.allclose(page.evaluate("ats.state().eye"), before["eye"], atol=1e-2), "meters"
        page.evaluate("headset.refuses = false")
        page.click("#headset")
        page.wait_for_function("ats.state().headset && headset.asked[0] === 'local-floor'")
        _frames(page, 6)
        inside = page.evaluate("ats.state()")
        assert np.allclose(inside["observer"], before["observer"], atol=1e-3), (
            "meters: it begins where one is"
        )
        floor_m = page.evaluate("ats.contract.scene.floor_m")
        assert inside["eye"][1] == pytest.approx(floor_m + 1.2, abs=1e-3), "meters, as the head is tracked"
        page.evaluate("headset.place = [0.4, 0.9, 0.0]")
        _frames(page, 4)
        stepped = page.evaluate("ats.state()")
        way = np.linalg.norm(np.subtract(stepped["observer"], inside["observer"]))
        assert way == pytest.approx(0.3, abs=0.02), "meters: as far as the head went"
        assert np.allclose(np.array(stepped["eye"])[[0, 2]], stepped["observer"], atol=0.05), (
            "meters: the camera that holds both eyes stands a little behind them"
        )
        page.evaluate("headset.session.pull()")
        aim = np.array(page.evaluate("ats.state().aim"))
        assert np.linalg.norm(aim - stepped["observer"]) == pytest.approx(0.7 / np.tan(0.8), abs=0.03), (
            "meters: where the beam of a hand 0.7 m above the floor meets it"
        )
        page.evaluate("headset.session.hand.gamepad.axes = [0, 0, 0, 1]")
        _frames(page, 6)
        assert np.linalg.norm(np.subtract(page.evaluate("ats.state().observer"), stepped["observer"])) > 0.05
        page.set_viewport_size({"width": 640, "height": 360})
        page.evaluate("headset.session.end()")
        page.wait_for_function("!ats.state().headset")
        _frames(page, 2)
        assert np.allclose(page.evaluate("ats.state().eye"), before["eye"], atol=1e-2), "meters"
        drawn, ratio = page.evaluate("[[view.width, view.height], ats.state().pixelRatio]")
        assert np.allclose(drawn, np.multiply([640, 360], ratio), atol=1), (
            "drawn pixels, rounded, of a window whose size changed meanwhile"
        )
        assert wrong == []


def _frames(page: Page, count: int) -> None:
    page.wait_for_function(f"ats.frames() >= {page.evaluate('ats.frames()') + count}", timeout=30_000)
