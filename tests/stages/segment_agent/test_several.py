"""Two animals in one room: appearance is learned from turnarounds, and pixels are assigned to one animal."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.core.videos import Video
from pipeline.data.clips import Clip, Masks
from pipeline.segmentation.appearance import Example
from stages.segment_agent import bodies, free_space, identity, masks, several, stage
from stages.segment_agent.config import AnimalConfig, Config, LearningConfig
from stages.segment_agent.identities import config as identities_config
from stages.segment_agent.identities import stage as identities
from stages.segment_agent.segmenter import Mask
from stages.segment_agent.windows import Sphere, working_picture

_spec = importlib.util.spec_from_file_location(
    "room_with_animal", Path(__file__).parent.parent / "room_with_animal.py"
)
scenery = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenery)

OPTIONS = Config(learning=LearningConfig(examples=30, steps=60, batch=4, crop_px=96))
SHORT = identities_config.Config(portraits=12, steps=40, batch=4, crop_px=64)
VIDEOS = tuple(
    Video(f"v00{index}", "", "turnaround", "none", None, animal=name)
    for index, name in enumerate(("green", "orange"))
)


def nowhere(poses):
    return np.full_like(poses, np.nan)


@pytest.fixture(scope="module")
def turnarounds(tmp_path_factory):
    """Return the frames of a turnaround of each animal, by id."""
    folder = tmp_path_factory.mktemp("turnarounds")
    poses, agent = scenery.turnaround(24)
    for video, (first, second) in zip(
        VIDEOS, ((nowhere(agent), agent), (agent, nowhere(agent))), strict=True
    ):
        scenery.record(folder / video.id, poses, first, poses, world_from_other=second)
    return {video.id: folder / video.id for video in VIDEOS}


@pytest.fixture(scope="module")
def learned(turnarounds, tmp_path_factory):
    """Return the appearance artifact of both animals."""
    out = tmp_path_factory.mktemp("identities")
    identities.run(identities.Inputs(turnarounds, turnarounds), SHORT, out, videos=VIDEOS)
    return out


@pytest.fixture(scope="module")
def network(learned):
    return identity.Identities.load(learned)


@pytest.fixture(scope="module")
def portraits(learned):
    return identity.load_portraits(learned)


def test_portraits_are_saved_and_show_their_animal(portraits):
    assert {each.animal for each in portraits} == {0, 1}
    assert all((each.labels == 255).any() and each.color.shape[:2] == each.labels.shape for each in portraits)
    own = [each for each in portraits if each.animal == 1]
    examples = several.examples_of(portraits, 1, 3)
    assert len(examples) == 3
    assert examples[0].color is own[0].color and examples[-1].labels is own[-1].labels


def test_other_animals_in_a_turnaround_are_not_learned_as_background(monkeypatch):
    labels = np.zeros((60, 80), np.uint8)
    labels[20:30, 20:30] = 255
    segmenter = SimpleNamespace(
        clip=None,
        height_px=60,
        spheres=[Sphere(np.zeros(3), 1.0)] * 4,
        world_from_camera=[None] * 4,
        working_mask=lambda frame: SimpleNamespace(labels=labels),
        working_picture=lambda frame: np.zeros((60, 80, 3), np.uint8),
    )
    monkeypatch.setattr(masks, "project_sphere", lambda *_: (slice(10, 50), slice(10, 50)))
    given = []
    monkeypatch.setattr(masks, "learn", lambda examples, *_, **__: given.extend(examples))
    recognized = np.full((60, 80), -1.0)
    recognized[25:52, 20:52] = 1.0
    elsewhere = Example(np.zeros((9, 9, 3), np.uint8), np.full((9, 9), 255, np.uint8))
    known = masks.KnownAppearance([elsewhere], lambda frame: recognized)
    masks.learn_appearance(segmenter, None, OPTIONS, np.random.default_rng(0), known)
    assert given[-1] is elsewhere and len(given) == 5
    found = given[0].labels
    assert (found[20:30, 20:30] == 255).all(), "the animal"
    assert (found[30:50, 20:50] == 128).all(), "it may have rested there"
    assert (found[50:, 20:52] == 0).all() and (found[25:50, 50:52] == 0).all(), "too far from its track"
    recognized[:, 50:] = 1.0
    masks.learn_appearance(segmenter, None, OPTIONS, np.random.default_rng(0), known)
    assert (given[-2].labels[labels == 0] == 0).all(), "the rest of the room is recognized, too"


def test_appearances_are_distinguished_and_saved(network, turnarounds):
    assert network.names == ("green", "orange")
    clip = Clip.open(turnarounds["v001"])
    log_prob = network.predict(clip.color(3))
    assert np.exp(log_prob).sum(0) == pytest.approx(1, abs=1e-4)
    middle = identity.identity_log_odds(log_prob, 1)[50:70, 35:55]
    assert np.median(middle) > 0
    assert np.allclose(identity.identity_log_odds(log_prob, 0)[50:70, 35:55][middle > 3].max(), -3, atol=3.1)


def test_two_turnarounds_of_the_same_appearance_are_refused(turnarounds, tmp_path):
    twice = dict.fromkeys(turnarounds, turnarounds["v000"])
    with pytest.raises(InputError, match="MSK-005"):
        identities.run(identities.Inputs(twice, twice), SHORT, tmp_path, videos=VIDEOS)


def test_touching_bodies_are_separated_and_a_patch_does_not_split_one():
    moving = np.zeros((80, 80), bool)
    moving[30:50, 10:70] = True
    log_odds = np.where(np.arange(80) < 40, 4.0, -4.0) * np.ones((80, 1))
    own, probability = identity.select_animal(moving, log_odds)
    assert own[30:50, 10:38].all()
    assert not own[:, 42:].any()
    patch = np.full((80, 80), 4.0)
    patch[38:42, 30:34] = -4.0
    own, probability = identity.select_animal(moving, patch)
    assert own[moving].all()
    assert (probability[moving] > 0.9).all()


def test_bodies_that_touch_in_the_picture_are_split_at_depth_steps():
    moving = np.zeros((40, 60), bool)
    moving[10:30, 10:50] = True
    slope = np.linspace(1.0, 1.4, 60, dtype=np.float32) * np.ones((40, 1), np.float32)
    (whole,) = bodies.split_bodies(moving, slope)
    assert whole.sum() == moving.sum()
    first, second = bodies.split_bodies(moving, np.where(np.arange(60) < 30, slope, slope + 0.2))
    assert (
        first[:, :28].any() and not first[:, 30:].any() and second[:, 32:].any() and not second[:, :30].any()
    )


GRID = (40, 60)


def margins_of(*scores):
    return [lambda _, score=score: score * np.ones((GRID[0], 1)) for score in scores]


def test_animal_is_present_where_whole_bodies_show_it_not_where_parts_do(monkeypatch):
    moving = np.zeros(GRID, bool)
    moving[10:30, 10:50] = True
    grid = np.stack([*np.mgrid[0:40, 0:60] / 100, np.ones(GRID)], axis=-1)
    every = (slice(None), slice(None))
    monkeypatch.setattr(free_space, "interior_depth", lambda *_: np.ones(GRID, np.float32))
    monkeypatch.setattr(free_space, "sample", lambda *_: (grid, np.full(GRID, 1e-4), every))
    monkeypatch.setattr(free_space, "vote", lambda *_: free_space.Votes(9 * moving, 0 * moving, None, None))
    clip, poses = SimpleNamespace(depth_size=GRID), np.repeat(np.eye(4)[None], 7, axis=0)
    most = np.where(np.arange(60) < 20, -6.0, 6.0)
    for largest_m, wanted in ((1.3, [7, 0]), (0.3, [0, 0])):
        found = bodies.find_bodies(clip, poses, None, AnimalConfig(largest_m))
        found = bodies.recognize(clip, found, margins_of(most, -most))
        assert bodies.count(found).tolist() == wanted
        assert all(row.whole.all() for row in found)
    moving[:, :50] = True
    assert not bodies.find_bodies(clip, poses, None, AnimalConfig())[0].whole.any(), "cut by the border"


def two_bodies(log_odds, whole=(True, True)):
    """Return a frame with two bodies, the second on the right, and the log-odds of both for each animal."""
    label = np.zeros(GRID, np.uint8)
    label[10:30, 5:25], label[10:30, 35:55], label[35:38] = 1, 2, bodies.MOVES
    every = (slice(None), slice(None))
    return bodies.Bodies(label, np.array(whole), every, np.array(log_odds, float))


def test_only_whole_bodies_that_surely_show_an_animal_are_learned(monkeypatch):
    monkeypatch.setattr(bodies, "working_picture", lambda *_: np.zeros((*GRID, 3), np.uint8))
    monkeypatch.setattr(bodies, "working_size", lambda *_: GRID)
    rows = [two_bodies([[4, -4], [-4, 4]]), two_bodies([[4, -4], [-4, 4]], (True, False))]
    rows += [two_bodies([[1.5, -4], [-4, 1.5]]), two_bodies([[4, 4], [-4, -4]])]
    assert bodies.sure(rows, 0, 9) == [(0, 1), (1, 1)], "sure, and alone"
    assert bodies.sure(rows, 1, 9) == [(0, 2)], "not cut by the border"
    assert bodies.sure(rows, 0, 1) == [(0, 1)]
    labels = bodies.portrait(None, rows, 40, 1, 0, 2).labels
    assert (labels[10:30, 35:55] == 255).all() and not labels[:5].any(), "body and room"
    assert (labels[10:30, 5:25] == 128).all() and (labels[36] == 128).all(), "what else moves"


def test_sure_bodies_are_one_animals_as_a_whole():
    row, claims = two_bodies([[4, 1.5], [-4, -4]]), np.zeros((2, *GRID), np.uint8)
    claims[0, 9:30, 5:20], claims[1, 9:30, 15:55] = 255, 255
    segmenters = [SimpleNamespace(masks=lambda _, own=own: iter([Mask(own, True, 1.0)])) for own in claims]
    scores = SimpleNamespace(against_others=lambda animal: lambda _: np.full(GRID, 2.0 * animal - 1))
    first, second = (each.labels for each in several.resolve_overlaps(segmenters, scores, 0, row))
    assert (first[9:30, 5:25] == 255).all() and (second[9:30, 5:25] == 128).all(), "thin parts too"
    assert (first[9:30, 35:55] == 128).all() and (second[9:30, 35:55] == 255).all(), "not sure"
    (row,) = bodies.restricted([row], np.array([False, True]))
    first, second = (each.labels for each in several.resolve_overlaps(segmenters, scores, 0, row))
    assert (first[9:30, 15:20] == 128).all() and (second[9:30, 15:20] == 255).all(), "the network decides"


@pytest.fixture(scope="module")
def together(tmp_path_factory):
    """Return a session in which the animals pass each other, and its ground truth."""
    poses, agent = scenery.session()
    other = agent[np.r_[36:2:-1, [2] * 6]].copy()
    other[:, 2, 3] += 0.45
    folder = tmp_path_factory.mktemp("together") / "frames"
    return folder, scenery.record(folder, poses, agent, scenery.drifted(poses), world_from_other=other)


def test_nothing_is_learned_if_an_animal_that_is_here_has_no_sure_bodies(network, portraits, together):
    scores = several.IdentityScores(Clip.open(together[0]), network, OPTIONS.height_px)
    rows = [two_bodies([[4, -4], [-4, 1]])] * 9
    same, unknown = several.adapt(scores, portraits, rows, np.array([True, True]), OPTIONS)
    assert same is scores and not bodies.count(unknown).any()


def test_sure_bodies_teach_how_animals_look_in_another_light(network, portraits, together, monkeypatch):
    folder, truth = together
    clip, light = Clip.open(folder), np.array([0.6, 0.85, 1.35])

    def lit(clip, frame, height_px):
        return np.clip(working_picture(clip, frame, height_px) * light, 0, 255).astype(np.uint8)

    for module in (several, bodies):
        monkeypatch.setattr(module, "working_picture", lit)
    rows = []
    for frame in range(0, 36, 2):
        label = (truth.others[frame] + 2 * truth.masks[frame]).astype(np.uint8)
        taught = np.full(2, frame % 4 == 0)
        rows.append(bodies.Bodies(label, taught, (slice(None), slice(None)), 8 * np.eye(2) - 4))
    before = several.IdentityScores(clip, network, OPTIONS.height_px)
    config = replace(OPTIONS, learning=LearningConfig(examples=12, steps=100, batch=4, crop_px=64))
    after, found = several.adapt(before, portraits, rows, np.array([True, True]), config)
    assert after.adapted and not before.adapted and before.network is network
    confused = bodies.recognize(clip, rows, before.margins)
    assert bodies.count(confused)[1] < 4, "orange looks green in bluish light"
    assert (bodies.count(found) > 13).all(), "of 18 frames, half of which were learned"
    right = [row.log_odds.argmax(0).tolist() == [0, 1] for row in found]
    assert sum(right) > 15 and sum(row.log_odds.argmax(0).tolist() == [0, 1] for row in confused) < 9


@pytest.mark.slow
def test_identities_persist_when_animals_pass_each_other(network, portraits, together):
    folder, truth = together
    animals = several.segment(Clip.open(folder), Path("none"), network, portraits, OPTIONS)
    for name, own, others in (("orange", truth.masks, truth.others), ("green", truth.others, truth.masks)):
        found = animals[name]
        labels = np.stack([mask.labels for mask in found.masks])
        shown = own.mean((1, 2)) > 0.002
        score = [
            ((mask == 255) & true).sum() / ((mask == 255) | true).sum()
            for mask, true in zip(labels[shown], own[shown], strict=True)
        ]
        assert np.mean(score) > 0.7, "share; the pictures are 90 pixels wide"
        assert (labels[others] == 255).mean() < 0.03, "of the other's pixels"
        assert (labels[others] == 128).mean() > 0.6, "they are neither the animal nor the room"
        assert found.unknown_animals < 0.1


@pytest.mark.slow
def test_masks_of_all_animals_are_written_once_and_an_absent_one_has_none(learned, tmp_path):
    poses, agent = scenery.session()
    scenery.record(tmp_path / "frames", poses, agent, scenery.drifted(poses))
    made, own = tmp_path / "home_masks", tmp_path / "masks"
    made.mkdir()
    stage.run(stage.Inputs(tmp_path / "frames", Path("none"), identities=learned), OPTIONS, made)
    assert not any((mask == 255).any() for mask in Masks.open(made / "green"))
    checks = json.loads((made / "qa.json").read_text())["checks"]
    assert "green: frames with a stranger" in {each["name"] for each in checks}
    assert not any(each["name"].startswith("green: IoU") for each in checks), "it may be away"
    own.mkdir()
    inputs = stage.Inputs(tmp_path / "frames", Path("none"), home_masks=made)
    stage.run(inputs, OPTIONS, own, videos=VIDEOS[1:])
    assert np.mean([(mask == 255).any() for mask in Masks.open(own)]) > 0.5
    names = [{str(path.relative_to(root)) for path in root.rglob("*")} for root in (own, made / "orange")]
    assert names[0] == names[1] > {"qa.json", "masks.npz", "people.npz"}


@pytest.mark.slow
def test_third_animal_without_turnaround_is_reported(network, portraits, tmp_path, monkeypatch):
    monkeypatch.setattr(scenery, "ANIMAL_COLOR", np.array([60, 70, 190]))
    poses, agent = scenery.session()
    scenery.record(tmp_path / "frames", poses, agent, scenery.drifted(poses))
    clip = Clip.open(tmp_path / "frames")
    with pytest.raises(InputError, match="MSK-007"):
        several.segment(clip, Path("none"), network, portraits, OPTIONS)


def test_prompt_with_unknown_animal_is_refused(network, together, tmp_path):
    network.save(tmp_path)
    prompt = tmp_path / "prompt.toml"
    prompt.write_text("frame = 0\nclick = [0.5, 0.5]\n")
    with pytest.raises(InputError, match="MSK-006"):
        stage.run(stage.Inputs(together[0], Path("none"), prompt, tmp_path), OPTIONS, tmp_path)


@pytest.mark.parametrize("shown", [0, 2])
def test_an_animal_that_hardly_any_mask_shows_is_refused(turnarounds, tmp_path, monkeypatch, shown):
    portraits = identities.portraits

    def few(frames, flow, animal, config, rng):
        return portraits(frames, flow, animal, config, rng)[: shown if animal else None]

    monkeypatch.setattr(identities, "portraits", few)
    with pytest.raises(InputError, match="MSK-008"):
        identities.run(identities.Inputs(turnarounds, turnarounds), SHORT, tmp_path, videos=VIDEOS)
