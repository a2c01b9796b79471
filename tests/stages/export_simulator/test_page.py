"""The page in headless Chromium from a file: it runs offline, samples like Python, and reacts to input."""

import base64
import functools
import gzip
import http.server
import json
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import trimesh
from playwright.sync_api import Browser, Page

from pipeline.behavior.avoidance import clearance_of
from pipeline.behavior.trajectories import BehaviorData
from pipeline.data import npz, ply
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh, RayCaster
from stages.simulate.subgoal_file import read
from tests.stages.export_simulator import browser, reaction, small_world, twins

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path(browser.CHROMIUM).exists(), reason="Chromium is not installed"),
]
DROP = """text => {
  const data = new DataTransfer();
  data.items.add(new File([Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0))], 'dropped.npz'));
  dispatchEvent(new DragEvent('drop', { dataTransfer: data, cancelable: true }));
}"""
SPOILS_THE_FIRST_PLAN = """
  const post = Worker.prototype.postMessage;
  let spoiled = false;
  Worker.prototype.postMessage = function (message, ...rest) {
    const spoil = message.kind === 'plan' && !spoiled;
    spoiled ||= spoil;
    return post.call(this, spoil ? { ...message, content: { ...message.content, past: null } } : message,
    ...rest);
  };
"""
WALKS_WHILE_THE_FIRST_PLAN_IS_AWAITED = """
  const post = Worker.prototype.postMessage;
  window.told = [];
  Worker.prototype.postMessage = function (message, ...rest) {
    if (message.kind !== 'plan') return post.call(this, message, ...rest);
    told.push(message.content.observer);
    if (told.length > 1) return post.call(this, message, ...rest);
    dispatchEvent(new KeyboardEvent('keydown', { key: 'w', code: 'KeyW' }));
    setTimeout(() => post.call(this, message, ...rest), 2000);
  };
"""
STEPS_IN_ITS_WAY = """() => new Promise((done) => {
  let last = null;
  const look = () => {
    const [x, , z] = ats.state().animal;
    const [dx, dz] = last ? [x - last[0], z - last[1]] : [0, 0];
    const step = Math.hypot(dx, dz);
    if (last && step > 0.02) {
      const person = [x + (0.25 * dx) / step, z + (0.25 * dz) / step];
      ats.moveObserver(person);
      return done(person);
    }
    last = [x, z];
    setTimeout(look, 100);
  };
  look();
})"""
SEES_ALL = (
    "points => points.map(ats.screen).every(([x, y]) => x > 0 && x < innerWidth && y > 0 && y < innerHeight)"
)


def test_page_runs_and_animal_reacts_to_the_observer(simulator: Path, chromium: Browser) -> None:
    golden = json.loads((simulator.parent / "golden.json").read_bytes())
    with browser.shown(chromium, (simulator / "index.html").as_uri()) as (page, wrong):
        before = page.evaluate("ats.state()")
        assert 0 < before["marks_s"]["animal"] < before["marks_s"]["plan"], (
            "seconds after opening: the animal is seen, then plans"
        )
        check_golden(golden, page.evaluate("golden => ats.golden(golden)", golden))
        page.evaluate("ats.pause()")
        _check_reaction(page)
        _check_it_reacts_as_python_does(page, simulator.parent)
        page.evaluate("ats.play()")
        _check_the_person_is_carried(page)
        page.wait_for_function(f"ats.state().tick > {before['tick'] + 5}", timeout=120_000)
        after = page.evaluate("ats.state()")
        assert np.linalg.norm(np.subtract(after["animal"], before["animal"])[:3]) > 0.01, (
            "meters within half a second"
        )
        assert wrong == []


def test_page_samples_positions_without_corrections_as_python_does(chromium: Browser, tmp_path: Path) -> None:
    small_world.write(tmp_path / "raw", paper=True)
    golden = json.loads((tmp_path / "raw/behavior/golden.json").read_bytes())
    simulator = small_world.exported(tmp_path / "raw", tmp_path / "simulator")
    with browser.shown(chromium, (simulator / "index.html").as_uri()) as (page, wrong):
        check_golden(golden, page.evaluate("golden => ats.golden(golden)", golden))
        tick = page.evaluate("ats.state()")["tick"]
        page.wait_for_function(f"ats.state().tick > {tick + 5}", timeout=120_000)
        assert wrong == []


def test_goals_and_paths_are_followed_and_takes_are_saved(
    simulator: Path, chromium: Browser, tmp_path: Path
) -> None:
    with browser.shown(
        chromium, (simulator / "index.html").as_uri(), size=(900, 760), accept_downloads=True
    ) as (page, wrong):
        _check_a_clicked_goal(page)
        _check_goals_in_turn(page, tmp_path)
        _check_a_goal_in_a_cupboard(page)
        _check_a_drawn_path(page)
        _check_downloads(page, tmp_path)
        _check_a_clip_beside(page)
        _check_an_opened_take(page, tmp_path)
        assert wrong == []


def test_animal_walks_around_a_standing_person(simulator: Path, chromium: Browser) -> None:
    """Goals alternate on both sides of a standing person; each is reached without violating the clearance."""
    person, goals = [0.1, 0.1], [[-0.5, -0.4], [0.6, 0.5], [-0.4, 0.6], [0.6, -0.4]]
    with browser.shown(chromium, (simulator / "index.html").as_uri()) as (page, wrong):
        page.evaluate("place => ats.moveObserver(place)", person)
        gaps = []
        for goal in goals:
            page.evaluate("goal => ats.visit([goal])", goal)
            for state in browser.states(page, 300):
                gaps.append(np.hypot(state["animal"][0] - person[0], state["animal"][2] - person[1]))
                if state["aim"] is None:
                    break
            else:
                pytest.fail(f"half a minute, and it stands at {state['animal'][:3]}")
        min_m = clearance_of(small_world.rest()) - 0.04
        assert min(gaps[4:]) > min_m, "meters: two plans that fade into each other cut corners"
        assert wrong == []


def test_animal_stops_for_a_person_who_steps_in_its_way(simulator: Path, chromium: Browser) -> None:
    """Nearer than the clearance, it does not come nearer, although its plan leads through the person."""
    with browser.shown(chromium, (simulator / "index.html").as_uri()) as (page, wrong):
        page.evaluate("ats.moveObserver([1.7, 1.7]); ats.visit([[-0.6, 0.5], [0.6, -0.5], [-0.6, 0.5]])")
        for _ in range(3):
            person = np.array(page.evaluate(STEPS_IN_ITS_WAY))
            places = [state["animal"] for state in browser.states(page, 12)]
            gaps = np.linalg.norm(np.array(places)[:, [0, 2]] - person, axis=1)
            assert gaps[0] < 0.35, "meters: nearer than the clearance"
            assert min(gaps) > gaps[0] - 0.03, "meters"
            page.evaluate("ats.moveObserver([1.7, 1.7])")
            page.wait_for_timeout(1500)
        assert wrong == []


def check_golden(golden: dict, sampled: dict) -> None:
    for name, plan in golden["plans"].items():
        for level, expected in plan.items():
            expected, found = np.array(expected), np.array(sampled[name][level])
            assert np.abs(found - expected).max() <= 1e-3 * expected.std(), f"{name} {level}"


def _check_reaction(page: Page) -> None:
    here = np.array(page.evaluate("ats.state()")["animal"])[[0, 2]]
    side = np.array([0.8, 0.6])
    near = here + 0.5 * side
    far = reaction.goals(page, here + 9 * side)
    assert np.abs(reaction.goals(page, here - 9 * side) - far).max() < 1e-5, "a far observer does not matter"
    assert (reaction.away_m(page, directions=4) > 0.3).all(), (
        "meters: away from who comes near, whichever way"
    )
    page.click("#panel-toggle")
    page.locator("#interactivity").press("Home")
    assert page.inner_text("#interactivity-value") == "0.00"
    assert np.abs(reaction.goals(page, near) - far).max() < 1e-5, "nor does one it is instructed to ignore"
    page.locator("#interactivity").press("End")
    page.locator("[data-sense=observer]").locator("xpath=..").click()
    assert "observer=0" in page.evaluate("location.hash")
    assert np.abs(reaction.goals(page, near) - far).max() < 1e-5, "nor one it is not aware of"
    page.locator("[data-sense=observer]").locator("xpath=..").click()
    assert np.abs(reaction.goals(page, near) - far).max() > 0.3, "meters: aware again"
    page.click("#panel-toggle")


def _check_it_reacts_as_python_does(page: Page, build: Path) -> None:
    """The same fraction of 200 approaches shifts goals away as in Python, and goals agree."""
    met = twins.approaches(BehaviorData.load(build / "behavior_data"), 200, np.random.default_rng(0))
    here = twins.goals_of_page(page, met, 5)
    there = twins.goals_of_python(build, build / "simulator", met, 5)
    assert 0.6 < there.rate(met.side) < 0.85, (
        "goals shift away from whoever is nearer than 1.8 m, which are 70 %"
    )
    assert 0.2 < there.rate(met.side, 0.4) < 0.8, "not all of them far"
    for further_m in (0.1, 0.3, 0.4, 0.5):
        assert abs(here.rate(met.side, further_m) - there.rate(met.side, further_m)) < 0.03
    assert np.median(np.abs(here.near - there.near)) < 1e-3, "meters"
    for answers in (here, there):
        assert np.abs(answers.opposite - answers.far[:5]).max() < 1e-5, "a far observer does not matter"
        assert np.abs(answers.ignored - answers.far[:5]).max() < 1e-5, (
            "nor does one it is instructed to ignore"
        )


def _check_the_person_is_carried(page: Page) -> None:
    page.evaluate("ats.moveObserver([1.0, 0.5])")
    page.wait_for_timeout(500)
    page.mouse.move(*page.evaluate("ats.screen([1.0, 0.8, 0.5])"))
    page.mouse.down()
    page.mouse.move(*page.evaluate("ats.screen([-0.2, 0, 1.2])"), steps=5)
    page.wait_for_function(
        "Math.hypot(ats.state().observer[0] + 0.2, ats.state().observer[1] - 1.2) < 0.1", timeout=10_000
    )
    page.mouse.up()
    page.keyboard.down("d")
    page.wait_for_function(
        "Math.hypot(ats.state().observer[0] + 0.2, ats.state().observer[1] - 1.2) > 0.3", timeout=10_000
    )
    page.keyboard.up("d")


def _check_a_clicked_goal(page: Page) -> None:
    """The animal reaches the clicked position and is then free again."""
    goal = np.array([-0.6, -0.5])
    page.mouse.click(*page.evaluate("ats.screen([-0.6, 0, -0.5])"))
    assert np.allclose(page.evaluate("ats.state().aim"), goal, atol=0.05), "meters"
    assert "aim=" in page.evaluate("location.hash")
    page.wait_for_function(
        "Math.hypot(ats.state().animal[0] + 0.6, ats.state().animal[2] + 0.5) < 0.3", timeout=120_000
    )
    page.wait_for_function("ats.state().aim === null", timeout=10_000)


def _check_goals_in_turn(page: Page, folder: Path) -> None:
    """Several clicked goals are saved in the address and as a file, and visited in order."""
    goals = np.array([[0.6, -0.4], [0.5, 0.6], [-0.4, 0.5]])
    page.click("#pins")
    for x, z in goals[:2]:
        page.mouse.click(*page.evaluate("p => ats.screen(p)", [x, 0, z]))
    page.click("#pins")
    page.keyboard.down("Shift")
    page.mouse.click(*page.evaluate("p => ats.screen(p)", [goals[2, 0], 0, goals[2, 1]]))
    page.keyboard.up("Shift")
    np.testing.assert_allclose(page.evaluate("ats.state().stops"), goals, atol=0.05)  # meters
    assert page.evaluate("new URLSearchParams(location.hash.slice(1)).get('aim').split(';').length") == 3
    begin = page.evaluate("ats.state().animal")
    with page.expect_download() as download:
        page.click("#toml")
    download.value.save_as(folder / "goals.toml")
    journey = read(folder / "goals.toml")
    assert (
        np.linalg.norm(journey[0].position_world - begin[:3]) < 0.5 and journey[0].heading_rad is not None
    ), "meters: it begins where it was"
    np.testing.assert_allclose([stop.position_world[[0, 2]] for stop in journey[1:]], goals, atol=0.05)
    for left in (2, 1, 0):
        place = _place_when_stops_are(page, left)
        assert np.linalg.norm(place - goals[2 - left]) < 0.6, "meters: it is at the stop that is next in turn"


def _place_when_stops_are(page: Page, left: int) -> np.ndarray:
    """Return [x, z] in meters at the moment with a given number of remaining stops, in a single call of the
    page.
    """
    state = page.wait_for_function(
        "left => { const { stops, animal } = ats.state(); return stops.length === left && animal; }",
        arg=left,
        timeout=120_000,
    )
    return np.array(state.json_value())[[0, 2]]


def _check_a_goal_in_a_cupboard(page: Page) -> None:
    """For an unreachable goal the animal stops as near as possible and continues with the next one."""
    page.evaluate("ats.visit([[1.8, -1.8], [0.3, -0.2]])")
    place = _place_when_stops_are(page, 1)
    assert np.linalg.norm(place - [1.8, -1.8]) < 1.0, "meters: beside the cupboard, which is 0.7 m wide"
    page.wait_for_function("ats.state().aim === null", timeout=120_000)


def _check_a_drawn_path(page: Page) -> None:
    """A drawn path is followed within 0.1 m to its end."""
    angle = np.linspace(np.pi, 0.2, 12)
    stroke = np.stack([0.1 + 0.7 * np.cos(angle), 0 * angle, 0.1 + 0.7 * np.sin(angle)], -1)
    page.click("#pen")
    page.mouse.move(*page.evaluate("p => ats.screen(p)", stroke[0].tolist()))
    page.mouse.down()
    page.mouse.move(*page.evaluate("p => ats.screen(p)", stroke[-1].tolist()), steps=4)
    page.keyboard.press("Escape")
    page.mouse.up()
    assert page.evaluate("ats.state().route") is None, "a stroke that was given up"
    page.click("#pen")
    page.mouse.move(*page.evaluate("p => ats.screen(p)", stroke[0].tolist()))
    page.mouse.down()
    for point in stroke[1:]:
        page.mouse.move(*page.evaluate("p => ats.screen(p)", point.tolist()))
    page.mouse.up()
    assert "route=" in page.evaluate("location.hash")
    route = np.array(page.evaluate("ats.state().route.points"))
    assert np.linalg.norm(route[-1] - stroke[-1, [0, 2]]) < 0.1, (
        "meters: the route ends where the stroke does"
    )
    drawn_at = page.evaluate("ats.state().tick")
    page.wait_for_function(
        "tick => ats.state().tick >= tick + 5", arg=drawn_at
    )  # the last plan has faded out
    aside, ends = [], []
    for state in browser.states(page, 600):
        if state["route"] is None:
            break
        place = np.array(state["animal"])[[0, 2]]
        aside.append(np.linalg.norm(route - place, axis=1).min())
        ends.append(np.linalg.norm(route[-1] - place))
    else:
        pytest.fail("a minute: plans take long on a busy machine")
    assert np.median(aside) < 0.1 and min(ends) < 0.2, "meters"


def _check_downloads(page: Page, folder: Path) -> None:
    """Table and model contain the same take."""
    page.evaluate("ats.pause()")
    for kind in ("csv", "glb"):
        with page.expect_download() as download:
            page.click(f"#{kind}")
        download.value.save_as(folder / f"take.{kind}")
    table = np.genfromtxt(folder / "take.csv", delimiter=",", names=True)
    assert len(table) > 20 and np.allclose(np.diff(table["time_s"]), 0.1, atol=1e-4)
    model = pygltflib.GLTF2().load(str(folder / "take.glb"))
    animation = model.animations[0]
    track = model.accessors[animation.samplers[0].output]
    view = model.bufferViews[track.bufferView]
    place = np.frombuffer(model.binary_blob(), "<f4", track.count * 3, view.byteOffset).reshape(-1, 3)
    np.testing.assert_allclose(place, np.stack([table[axis] for axis in "xyz"], -1), atol=2e-5)
    assert len(animation.channels) == 2 * (1 + small_world.BONES)
    assert len(trimesh.load(folder / "take.glb").geometry) == 1
    page.evaluate("ats.reset()")
    for kind in ("csv", "glb"):
        page.click(f"#{kind}")
        assert "nothing yet" in page.inner_text("#help"), "a model without keys would be invalid"
    page.evaluate("ats.play()")


def _check_a_clip_beside(page: Page) -> None:
    """A recorded session is played beside the simulation, from the same start."""
    page.select_option("#replay", "v002")
    page.wait_for_function("ats.state().replay && ats.state().tick > 4", timeout=20_000)
    state = page.evaluate("ats.state()")
    truth = small_world.trajectory(120, 0).world_from_agent[state["replay"]["tick"], :3, 3]
    np.testing.assert_allclose(state["replay"]["place"], truth, atol=5e-4)  # meters: clips are half precision
    assert np.linalg.norm(np.array(state["animal"])[[0, 2]] - truth[[0, 2]]) < 1.5, "meters: it began there"


def _check_an_opened_take(page: Page, folder: Path) -> None:
    """A 30 Hz take of `stages.simulate` is opened or dropped and played; that of another body is refused."""
    time_s = np.arange(181) / 30
    place = np.stack([0.5 * np.cos(time_s), np.full(181, 0.1), 0.5 * np.sin(time_s)], -1)
    motion = {
        "world_from_agent": rigid.make(np.tile(np.eye(3), (181, 1, 1)), place),
        "arrival_s": np.zeros(1),
    }
    bones = np.tile(small_world.rest(), (181, 1, 1, 1)).astype(np.float32)
    npz.save(folder / "journey.npz", timestamp_s=time_s, agent_from_bone=bones, **motion)
    npz.save(folder / "dropped.npz", timestamp_s=time_s, agent_from_bone=bones, **motion, compress=True)
    npz.save(folder / "other.npz", timestamp_s=time_s, agent_from_bone=bones[:, :3], **motion)
    page.set_input_files("#open-file", folder / "journey.npz")
    _check_it_plays(page, "journey", place)
    dropped = base64.b64encode((folder / "dropped.npz").read_bytes()).decode()
    page.evaluate(DROP, dropped)
    _check_it_plays(page, "dropped", place)
    page.set_input_files("#open-file", folder / "other.npz")
    page.wait_for_function(
        "document.querySelector('#help').textContent.includes('it has 3 bones, this animal has 5')",
        timeout=10_000,
    )


def _check_it_plays(page: Page, name: str, place: np.ndarray) -> None:
    page.wait_for_function(f"ats.state().replay?.name === '{name}' && ats.state().tick > 2", timeout=20_000)
    replay = page.evaluate("ats.state().replay")
    np.testing.assert_allclose(replay["place"], place[3 * (replay["tick"] % 61)], atol=1e-5)  # meters


def test_keys_work_while_the_panel_has_focus(simulator: Path, chromium: Browser) -> None:
    with browser.shown(chromium, (simulator / "index.html").as_uri(), size=(900, 760)) as (page, wrong):
        page.locator("#interactivity").press("ArrowLeft")
        assert page.input_value("#interactivity") == "1.2", "arrows are the slider's"
        _check_a_key_walks(page, "w")
        page.locator("[data-sense=past]").focus()
        page.keyboard.press("Space")
        assert page.evaluate("ats.state().settings.past") == 0 and page.inner_text("#play") == "pause", (
            "space is the box's"
        )
        _check_a_key_walks(page, "ArrowUp")
        page.locator("#view").focus()
        for _ in range(2):
            page.keyboard.down("Space")
        page.keyboard.up("Space")
        assert page.inner_text("#play") == "go on", "once, although the key repeats"
        page.keyboard.press("Space")
        page.locator("#seed").focus()
        page.keyboard.down("w")
        _check_nobody_walks(page)
        page.keyboard.up("w")
        page.locator("#view").focus()
        page.keyboard.down("s")
        page.keyboard.down("Alt")
        page.keyboard.up("s")
        page.keyboard.up("Alt")
        _check_nobody_walks(page)
        for key in "?h":
            page.wait_for_function("document.getElementById('help').classList.contains('gone')")
            page.keyboard.press(key)
            assert "gone" not in str(page.get_attribute("#help", "class"))
            page.keyboard.press(key)
        assert wrong == []


def _check_a_key_walks(page: Page, key: str) -> None:
    before = page.evaluate("ats.state().observer")
    page.keyboard.down(key)
    page.wait_for_function(
        "([x, z]) => Math.hypot(ats.state().observer[0] - x, ats.state().observer[1] - z) > 0.1",
        arg=before,
        timeout=10_000,
    )
    page.keyboard.up(key)


def _check_nobody_walks(page: Page) -> None:
    before = page.evaluate("ats.state()")
    page.wait_for_function(f"ats.state().tick > {before['tick'] + 2}", timeout=10_000)
    assert page.evaluate("ats.state().observer") == before["observer"]


def test_walking_speed_is_limited(simulator: Path, chromium: Browser, tmp_path: Path) -> None:
    """Before the first plan and in slow motion too: no step exceeds 0.11 m per 0.1 s of simulated time."""
    address = (simulator / "index.html").as_uri() + "#speed=0.3&at=1.2,1.2"
    with browser.shown(chromium, address, script=WALKS_WHILE_THE_FIRST_PLAN_IS_AWAITED) as (page, wrong):
        assert np.linalg.norm(np.subtract(page.evaluate("ats.state().observer"), 1.2)) > 0.3, (
            "meters, while the first plan is awaited"
        )
        page.wait_for_function("ats.state().take_s > 0.5 && told.length > 1", timeout=120_000)
        page.keyboard.up("w")
        with page.expect_download() as download:
            page.evaluate("document.querySelector('#csv').click()")
        download.value.save_as(tmp_path / "take.csv")
        table = np.genfromtxt(tmp_path / "take.csv", delimiter=",", names=True)
        told = np.array(page.evaluate("told.at(-1)"))
        for places in (np.stack([table["observer_x"], table["observer_z"]], -1), told[:, [0, 2]]):
            steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
            assert 0.05 < steps.max() < 0.115, "meters"
        assert wrong == []


def test_initial_view_shows_the_animal(simulator: Path, chromium: Browser, tmp_path: Path) -> None:
    """A box occludes the animal from the default viewpoint."""
    with browser.shown(chromium, (simulator / "index.html").as_uri()) as (page, _):
        page.evaluate("ats.pause(); ats.reset()")
        eye, animal = (np.array(page.evaluate(f"ats.state().{what}")[:3]) for what in ("eye", "animal"))
        assert not page.evaluate("ats.state().outlined")
    place = animal + 0.4 * (eye - animal) / np.linalg.norm((eye - animal)[[0, 2]])
    box = trimesh.creation.box((0.3, 0.3, 0.3), rigid.make(np.eye(3), place))
    cast = RayCaster(Mesh(np.asarray(box.vertices, np.float32), np.asarray(box.faces))).cast
    out = _exported_with(box, tmp_path)
    with browser.shown(chromium, (out / "index.html").as_uri()) as (page, wrong):
        shown_from = np.array(page.evaluate("ats.state().eye"))
        assert (
            cast(eye, (animal - eye)[None]).distance[0]
            < 1
            < cast(shown_from, (animal - shown_from)[None]).distance[0]
        )
        assert wrong == []


def test_occluded_animal_is_outlined(simulator: Path, chromium: Browser, tmp_path: Path) -> None:
    """A lid above the animal occludes it from all views from above."""
    with browser.shown(chromium, (simulator / "index.html").as_uri()) as (page, _):
        page.evaluate("ats.pause(); ats.reset()")
        x, y, z = page.evaluate("ats.state().animal")[:3]
    lid = trimesh.creation.box((1.2, 0.02, 1.2), rigid.make(np.eye(3), np.array([x, y + 0.35, z])))
    out = _exported_with(lid, tmp_path)
    with browser.shown(chromium, (out / "index.html").as_uri()) as (page, wrong):
        page.evaluate("ats.pause(); ats.reset()")
        page.wait_for_function("ats.state().outlined", timeout=10_000)
        assert page.evaluate("ats.state().settings.outline") == 0
        assert wrong == []


def _exported_with(thing: trimesh.Trimesh, folder: Path) -> Path:
    """Export the small world with an additional mesh."""
    small_world.write(folder)
    scene = ply.read_ply(folder / "reconstruction/scene.ply")
    vertices = np.concatenate([scene.vertices, thing.vertices])
    faces = np.concatenate([scene.faces, thing.faces + len(scene.vertices)])
    color = np.concatenate([scene.color, np.full((len(thing.vertices), 3), 99)]).astype(np.uint8)
    ply.write_ply(
        folder / "reconstruction/scene.ply", Mesh(vertices.astype(np.float32), faces.astype(np.int32), color)
    )
    return small_world.exported(folder, folder / "build/simulator")


def test_hash_keeps_a_setting_on_a_phone(simulator: Path, chromium: Browser) -> None:
    address = (
        simulator / "index.html"
    ).as_uri() + "#interactivity=0.25&samples=16&steps=50&scene=0&aim=0.5,0.5"
    with browser.shown(chromium, address, size=(390, 780), has_touch=True, is_mobile=True) as (page, wrong):
        state = page.evaluate("ats.state()")
        kept = {"interactivity": 0.25, "samples": 16, "steps": 50, "scene": 0}
        assert {key: state["settings"][key] for key in kept} == kept
        assert state["aim"] == [0.5, 0.5]
        assert page.input_value("#interactivity") == "0.25"
        assert page.evaluate("document.documentElement.scrollWidth") <= 390, "pixels"
        page.touchscreen.tap(*page.evaluate("ats.screen([0.2, 0, -0.3])"))
        assert np.allclose(page.evaluate("ats.state().aim"), [0.2, -0.3], atol=0.05), "meters"
        assert not page.is_visible("#help")
        page.click("#how")
        assert page.is_visible("#help") and "Tap the floor" in page.inner_text("#help")
        page.click("#how")
        page.wait_for_function("document.getElementById('help').classList.contains('gone')")
        _check_a_followed_link(page)
        assert wrong == []


def _check_a_followed_link(page: Page) -> None:
    """A link that is followed in an open page has the same effect as in a new one."""
    page.evaluate("location.hash = '#replay=v002&view=animal&speed=0&samples=1'")
    page.wait_for_function("ats.state().replay?.name === 'v002'", timeout=10_000)
    state = page.evaluate("ats.state()")
    kept = {"replay": "v002", "view": "animal", "speed": 1, "samples": 1, "interactivity": 1.25}
    assert {key: state["settings"][key] for key in kept} == kept and state["aim"] is None
    page.wait_for_function("ats.state().tick > 2", timeout=20_000)


@pytest.mark.parametrize(
    ("script", "word"),
    [
        ("delete window.WebAssembly", "WebAssembly"),
        ("HTMLCanvasElement.prototype.getContext = () => null", "WebGL"),
    ],
)
def test_missing_capabilities_are_reported(
    simulator: Path, chromium: Browser, script: str, word: str
) -> None:
    with browser.shown(chromium, (simulator / "index.html").as_uri(), script=script) as (page, wrong):
        assert word in page.inner_text("#splash")
        assert wrong == []


def test_failed_plan_is_retried(simulator: Path, chromium: Browser) -> None:
    with browser.shown(chromium, (simulator / "index.html").as_uri(), script=SPOILS_THE_FIRST_PLAN) as (
        page,
        wrong,
    ):
        assert page.evaluate("ats.state().plans") >= 2
        assert wrong == []


def test_folder_variant_runs_on_a_static_host(simulator: Path, chromium: Browser) -> None:
    folder = simulator.parent / "light"
    assert (folder / "index.html").stat().st_size < 5e6 < (simulator / "index.html").stat().st_size

    with served(folder) as address, browser.shown(chromium, address) as (page, wrong):
        assert page.evaluate("ats.state().plans") >= 1
        assert [line for line in wrong if "favicon" not in line] == []


def test_unreadable_splats_fall_back_to_the_mesh(simulator: Path, chromium: Browser, tmp_path: Path) -> None:
    folder = shutil.copytree(simulator.parent / "light", tmp_path / "light")
    (folder / "assets/splats.gz").write_bytes(b"no splats")
    with served(folder) as address, browser.shown(chromium, f"{address}?splats") as (page, wrong):
        page.wait_for_function(
            "document.querySelector('#status').textContent.includes('drawn as a mesh')", timeout=120_000
        )
        assert page.evaluate("document.querySelector('#splash').classList.contains('gone')")
        assert [line for line in wrong if "favicon" not in line] == []


def test_large_hall_is_framed_like_a_room(simulator: Path, chromium: Browser, tmp_path: Path) -> None:
    folder = shutil.copytree(simulator.parent / "light", tmp_path / "light")
    model = json.loads(gzip.decompress((folder / "assets/simulator.gz").read_bytes()))
    model["scene"]["bounds_m"] = (np.array(model["scene"]["bounds_m"]) * [4, 1, 4]).tolist()
    (folder / "assets/simulator.gz").write_bytes(gzip.compress(json.dumps(model).encode()))
    size, half = (390, 780), 4 * small_world.HALF_ROOM_M
    with served(folder) as address, browser.shown(chromium, address, size=size) as (page, _):
        near, far = (np.array(page.evaluate("p => ats.screen(p)", [0, 0, side * half])) for side in (1, -1))
        assert 330 < np.linalg.norm(near - far) < 360, "pixels, as in a room of a quarter of the size"
        page.keyboard.down("-")
        corners = [[x, 0, z] for x in (-half, half) for z in (-half, half)]
        page.wait_for_function(SEES_ALL, arg=corners, timeout=20_000)


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder like a static host; yield the address of its page."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None: ...

    with http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Quiet, directory=folder)
    ) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/index.html"
        server.shutdown()
