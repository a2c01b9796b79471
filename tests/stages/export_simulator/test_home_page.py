"""The page of several animals: all are simulated, perceive each other as in Python, and react to input."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from pipeline.baselines.predictors import Ats
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import BehaviorData, Context, as_companions
from pipeline.core.errors import InputError
from pipeline.data import npz
from tests.stages.export_simulator import browser, small_world, twins
from tests.stages.export_simulator.test_page import check_golden

pytestmark = [
    pytest.mark.skipif(not Path(browser.CHROMIUM).exists(), reason="Chromium is not installed"),
    pytest.mark.slow,
]
ALL_PLAN = "ats.state().animals.every((animal) => animal.plans > 0)"


@pytest.fixture(scope="module")
def animals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("animals")
    small_world.write_home(folder)
    return folder


@pytest.fixture(scope="module")
def home(animals: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_world.exported_home(animals, tmp_path_factory.mktemp("home") / "page")


def test_contract_has_each_animal_and_one_room(home: Path, animals: Path) -> None:
    document = json.loads((home / "simulator.json").read_bytes())
    own = json.loads(
        (small_world.exported(animals / "cat", home.parent / "cat") / "simulator.json").read_bytes()
    )
    assert [animal["name"] for animal in document["animals"]] == ["cat", "dog"]
    cat = document["animals"][0]
    assert (
        cat["behavior"] == own["behavior"] and cat["agent"] == own["agent"] and cat["volume"] == own["volume"]
    )
    assert [clip["begin_s"] for clip in cat["clips"]] == [0.0, 0.0]
    text = (home / "index.html").read_text()
    for asset, times in (("room", 1), ("splats", 1), ("cat-perception", 1), ("dog-agent", 1), ("agent", 0)):
        assert text.count(f'id="asset-{asset}"') == times, asset
    whole, *parts = json.loads((home / "qa.json").read_bytes())["checks"]
    assert whole["value"] == pytest.approx(len(text.encode()) / 1e6) and whole["warn"] == 30.0
    assert whole["value"] == pytest.approx(sum(part["value"] for part in parts)) and len(parts) == 6
    inside = {part["name"]: part["value"] for part in parts}
    found = re.findall(r'id="asset-(?:cat|dog)-(?:goal|path|body|perception)"[^>]*>([^<]*)<', text)
    assert inside["of the page: networks"] == pytest.approx(sum(map(len, found)) / 1e6, rel=1e-2)


def test_animals_perceive_each_other_as_in_python(home: Path, animals: Path, chromium: Browser) -> None:
    with browser.shown(chromium, (home / "index.html").as_uri()) as (page, wrong):
        page.wait_for_function(ALL_PLAN, timeout=60_000)
        page.evaluate("ats.pause()")
        for index, name in enumerate(("cat", "dog")):
            golden = json.loads((animals / name / "behavior/golden.json").read_bytes())
            assert len(golden["input"]["others"]) == 2, "a person and a companion"
            check_golden(golden, page.evaluate("([golden, i]) => ats.golden(golden, i)", [golden, index]))
        _check_goals(page, home, animals / "cat")
        assert wrong == []


def test_recordings_beside_are_those_of_the_selected_animal(
    home: Path, take: Path, chromium: Browser
) -> None:
    listed = "[...document.querySelectorAll('#replay option')].map(({ value }) => value)"
    document = json.loads((home / "simulator.json").read_bytes())
    names = [clip["name"] for clip in document["animals"][1]["clips"]]
    address = f"{(home / 'index.html').as_uri()}#replay={names[1]}&animal=dog"
    with browser.shown(chromium, address, size=(1280, 720)) as (page, wrong):
        assert page.evaluate(listed) == ["", *names]
        assert page.evaluate("ats.state().replay.name") == names[1] == page.input_value("#replay")
        page.set_input_files("#open-file", take / "dog/take.npz")
        page.wait_for_function("ats.state().replay?.name === 'take'")
        assert page.evaluate(listed) == ["", *names, "take"]
        page.evaluate("ats.select('cat')")
        assert page.evaluate(listed) == ["", *(clip["name"] for clip in document["animals"][0]["clips"])]
        assert page.evaluate("ats.state().replay") is None and page.input_value("#replay") == ""
        page.evaluate("ats.select('dog')")
        assert page.evaluate(listed) == ["", *names, "take"]
        page.select_option("#replay", "take")
        assert page.evaluate("ats.state().replay.name") == "take" and wrong == []


def test_plan_has_the_goal_of_the_intent(home: Path, chromium: Browser) -> None:
    with browser.shown(chromium, (home / "index.html").as_uri()) as (page, wrong):
        page.wait_for_function(ALL_PLAN, timeout=60_000)
        page.evaluate("ats.pause()")
        goals = np.array(page.evaluate("ats.plan().then((plan) => plan.goals)"))
        assert np.ptp(goals, axis=0).max() > 0.2, "meters"
        ends = []
        for goal in goals[:4]:
            plan = page.evaluate(
                "(goal) => ats.plan({ intent: Array(56).fill(goal) }).then(({ goals, chosen, path }) =>"
                " ({ goals, chosen, end: path.at(-1) }))",
                goal.tolist(),
            )
            np.testing.assert_allclose(plan["goals"], [goal], atol=1e-4)
            assert plan["chosen"] == 0
            ends.append(plan["end"])
        assert np.ptp(np.array(ends), axis=0).max() > 0.1, "meters"
        assert wrong == []


@pytest.fixture(scope="module")
def take(animals: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Takes of both in another home, as `simulate` writes them: their second sessions."""
    folder = tmp_path_factory.mktemp("take")
    for name, share in (("cat", 0.42), ("dog", 0.9)):
        (folder / name).mkdir()
        recorded = BehaviorData.load(animals / name / "behavior_data").trajectories["v003"]
        arrays = {
            key: getattr(recorded, key) for key in ("timestamp_s", "world_from_agent", "agent_from_bone")
        }
        eyes = np.tile([0.2, 1.4, 0.0], (len(recorded.timestamp_s), 1))
        npz.save(folder / name / "take.npz", **arrays, observer_world=eyes)
        shutil.copy(animals / name / "behavior_data/volume.npz", folder / name)
        about = {"home": "other", "share_known": share}
        (folder / name / "home.json").write_text(json.dumps(about))
    return folder


def test_page_of_another_home_has_all_animals(animals: Path, take: Path, tmp_path: Path, chromium: Browser):
    out = small_world.exported_home(animals, tmp_path / "page", home=animals / "cat", take=take)
    document = json.loads((out / "simulator.json").read_bytes())
    for animal in document["animals"]:
        assert [clip["name"] for clip in animal["clips"]] == ["take"]
    warning = document["scene"]["warning"]
    assert "42% of it looks like the home that cat knows" in warning and "90%" in warning
    with browser.shown(chromium, (out / "index.html").as_uri()) as (page, wrong):
        page.wait_for_function(ALL_PLAN, timeout=60_000)
        assert page.inner_text("#warning") == warning and wrong == []
    shutil.copytree(take / "dog", tmp_path / "take/dog")
    alone = small_world.exported_home(animals, tmp_path / "dog", home=animals / "cat", take=tmp_path / "take")
    (dog,) = json.loads((alone / "simulator.json").read_bytes())["animals"]
    assert dog["name"] == "dog", "the cat was absent"
    with browser.shown(chromium, (alone / "index.html").as_uri()) as (page, wrong):
        page.wait_for_function(ALL_PLAN, timeout=60_000)
        assert wrong == []
    for number, more in enumerate(({"take": take}, {"home": take}, {"take": tmp_path / "no", "home": take})):
        with pytest.raises(InputError, match="EXP-003"):
            small_world.exported_home(animals, tmp_path / f"refused/{number}", **more)


def _check_goals(page: Page, home: Path, cat: Path) -> None:
    """Goals beside a companion with the same noise equal those of Python, and shift away from it."""
    met = twins.approaches(BehaviorData.load(cat / "behavior_data"), 20, np.random.default_rng(0))
    contract = json.loads((home / "simulator.json").read_bytes())
    height = np.full((*met.near.shape[:2], 1), 0.1)
    place = np.concatenate([met.near[..., :1], height, met.near[..., 1:]], axis=-1)
    past = np.concatenate(
        [twins.rows(met.context.world_from_agent[:, :, None]), twins.rows(met.context.agent_from_bone)],
        axis=2,
    )
    asked = {
        "past": past.reshape(*past.shape[:2], -1).tolist(),
        "observer": met.far.tolist(),
        "companions": place[:, None].tolist(),
        "seed": met.seed.tolist(),
    }
    questions = [dict(zip(asked, each, strict=True)) for each in zip(*asked.values(), strict=True)]
    found = {}
    for name, changes in {"near": {}, "alone": {"companions": []}, "guided": {"company": [1.6]}}.items():
        text = json.dumps(
            [q | changes | {"K": 1, "steps": twins.STEPS, "interactivity": 0.7} for q in questions]
        )
        found[name] = np.array(page.evaluate(twins.ASK, text))[:, [0, 2]]
    settings = contract["animals"][0]["behavior"]["sampling"]
    eyes_m = contract["scene"]["floor_m"] + contract["observer"]["eye_height_m"]
    eyes = np.stack([met.far[..., 0], np.full(met.far.shape[:2], eyes_m), met.far[..., 1]], -1)
    companions = np.stack([as_companions(each[None]) for each in place])
    context = Context(met.context.world_from_agent, met.context.agent_from_bone, eyes, companions=companions)
    for name, scales in (("near", (1.0,)), ("guided", (1.6,))):
        steps = max(twins.STEPS, settings["goal_steps"]), twins.STEPS
        sampling = PlanSamplingConfig(settings["method"], *steps, 0.7, scales)
        ats = Ats.load(cat / "behavior", Scenes.load(cat / "behavior_data", ("any",)), sampling)
        expected = ats.goals(context, 1, twins.PageNoise(met.seed)).goal[:, 0][:, [0, 2]]
        assert np.median(np.abs(found[name] - expected)) < 1e-3, "meters"
    assert np.median(np.abs(found["guided"] - found["near"])) > 0.02, "meters"
    away_m = -((found["near"] - found["alone"]) * met.side).sum(-1)
    assert (away_m > 0.1).mean() > 0.4, "it flees from whom it perceives"


def test_animals_are_selected_removed_and_replayed(home: Path, animals: Path, chromium: Browser) -> None:
    with browser.shown(chromium, (home / "index.html").as_uri(), size=(1100, 760)) as (page, wrong):
        page.wait_for_function(ALL_PLAN, timeout=60_000)
        gaps = []
        for _ in range(20):
            cat, dog = (np.array(each["place"])[[0, 2]] for each in page.evaluate("ats.state().animals"))
            gaps.append(np.linalg.norm(cat - dog))
            page.wait_for_timeout(100)
        assert min(gaps) > 0.3, "meters: bodies' 0.4, less what two plans that fade into each other cut"
        page.keyboard.press("n")
        assert page.get_by_role("radio", name="dog").is_checked()
        page.mouse.click(*page.evaluate("ats.screen([0.5, 0, -0.4])"))
        assert np.allclose(page.evaluate("ats.state().aim"), [0.5, -0.4], atol=0.05), "meters: the dog's"
        page.get_by_role("radio", name="cat").check()
        assert page.evaluate("ats.state().aim") is None
        assert page.get_by_role("radiogroup", name="The animal that clicks").count() == 1
        _check_it_is_away(page)
        _check_it_replays(page, animals)
        page.reload()
        page.wait_for_function(f"window.ats && {ALL_PLAN.replace('plans > 0', 'does || animal.plans > 0')}")
        assert page.evaluate("ats.state().animals.map(({ does }) => does)") == ["v002", ""], (
            "the address keeps it"
        )
        assert wrong == []


def test_reactions_to_one_animal_are_set_kept_and_restored(home: Path, chromium: Browser) -> None:
    address = (home / "index.html").as_uri()
    with browser.shown(chromium, f"{address}#guidance=bird:2", size=(1100, 760)) as (page, wrong):
        assert "guidance=bird:2" in page.inner_text("#help"), "what was ignored"
        page.wait_for_function(ALL_PLAN, timeout=60_000)
        before = page.evaluate("ats.state().animals.map(({ plans }) => plans)")
        page.get_by_role("combobox", name="To whom animals react").select_option("dog")
        assert page.inner_text("#interactivity-value") == "1.00", "of companions"
        page.locator("#interactivity").press("End")
        assert page.inner_text("#interactivity-value") == "2.00"
        assert page.locator(".hint.ends").first.inner_text().split() == "ignores dog reacts to dog".split()
        assert "guidance=dog%3A2" in page.evaluate("location.hash")
        page.wait_for_function("n => ats.state().animals.every((a, i) => a.plans > n[i])", arg=before)
        page.get_by_role("combobox", name="To whom animals react").select_option("")
        assert page.inner_text("#interactivity-value") == "1.25", "of the visitor, as before"
        page.reload()
        page.wait_for_function(f"window.ats && {ALL_PLAN}", timeout=60_000)
        assert page.evaluate("ats.state().settings.guidance") == "dog:2"
        page.get_by_role("combobox", name="To whom animals react").select_option("dog")
        assert page.inner_text("#interactivity-value") == "2.00" and wrong == []


def _check_it_is_away(page: Page) -> None:
    page.get_by_role("combobox", name="What cat does").select_option("off")
    assert "does=cat%3Aoff" in page.evaluate("location.hash")
    before = page.evaluate("ats.state()")
    page.wait_for_function(f"ats.state().tick > {before['tick'] + 3}", timeout=60_000)
    after = page.evaluate("ats.state()")
    assert after["animals"][0] == before["animals"][0], "no time passes for who is away"
    assert page.locator(".tag:visible", has_text="cat").count() == 0


def _check_it_replays(page: Page, animals: Path) -> None:
    page.get_by_role("combobox", name="What cat does").select_option("v002")
    before = page.evaluate("ats.state()")
    page.wait_for_function(f"ats.state().tick > {before['tick'] + 8}", timeout=60_000)
    page.evaluate("ats.pause()")
    place = np.array(page.evaluate("ats.state().animals[0].place"))[:3]
    recorded = (
        BehaviorData.load(animals / "cat/behavior_data").trajectories["v002"].world_from_agent[:, :3, 3]
    )
    assert np.linalg.norm(recorded - place, axis=1).min() < 0.04, "meters: half a step of the recording"
    plans = page.evaluate("ats.state().animals[0].plans")
    assert plans == before["animals"][0]["plans"], "none was asked for"
    page.evaluate("ats.play()")
