"""Masks of small rendered recordings: walking, resting and absent animals, and prompts."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.core.errors import InputError
from pipeline.data import images, npz
from pipeline.data.clips import MAPPED, Clip
from pipeline.segmentation import appearance
from pipeline.segmentation.appearance import Example, learn
from stages.segment_agent import masks, movers, prompts
from stages.segment_agent.config import AnimalConfig, Config, LearningConfig
from stages.segment_agent.movers import Candidate, PlacedPrompt

_spec = importlib.util.spec_from_file_location(
    "room_with_animal", Path(__file__).parent.parent / "room_with_animal.py"
)
scenery = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenery)

OPTIONS = Config(learning=LearningConfig(examples=30, steps=60, batch=4, crop_px=96))
"""short training for small pictures"""


def iou(found, truth) -> float:
    return (found & truth).sum() / max((found | truth).sum(), 1)


def make(folder, role, poses, agent, odometry, flow=Path("none"), prompt=None):
    """Render and segment a recording; return the masks and the truth."""
    truth = scenery.record(folder, poses, agent, odometry)
    found = masks.segment(Clip.open(folder), flow, role, prompt, OPTIONS, np.random.default_rng(0)).masks
    return list(found), truth


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    poses, agent = scenery.session()
    return make(tmp_path_factory.mktemp("walk") / "frames", "session", poses, agent, scenery.drifted(poses))


@pytest.mark.slow
def test_walking_and_resting_animal_is_segmented(walk):
    found, truth = walk
    scores = np.array(
        [iou(mask.labels == 255, true) for mask, true in zip(found, truth.masks, strict=True)][:-3]
    )
    assert scores.mean() > 0.8, "share; the pictures are 90 pixels wide"
    assert scores[12:28].mean() > 0.8, "at rest"
    assert scores.min() > 0.6


def test_masks_are_empty_without_animal(walk):
    found, _ = walk
    assert [mask.visible for mask in found[-3:]] == [False] * 3
    assert not any(mask.labels.any() for mask in found[-3:])


def test_masks_have_three_labels_at_color_resolution(walk):
    for mask in walk[0]:
        assert mask.labels.shape == scenery.COLOR_SIZE
        assert mask.labels.dtype == np.uint8
        assert set(np.unique(mask.labels)) <= {0, 128, 255}
        assert 0 <= mask.confidence <= 1


def test_standing_animal_is_segmented_in_a_turnaround(tmp_path):
    poses, agent = scenery.turnaround(30)
    found, truth = make(tmp_path / "frames", "turnaround", poses, agent, scenery.drifted(poses))
    assert (
        np.mean([iou(mask.labels == 255, true) for mask, true in zip(found, truth.masks, strict=True)]) > 0.85
    )


def test_foreground_completes_what_has_no_depth(tmp_path):
    poses, agent = scenery.turnaround(20)
    truth = scenery.record(tmp_path, poses, agent, poses)
    clip = Clip.open(tmp_path)
    (tmp_path / "foreground").mkdir()
    unknown = np.indices(scenery.DEPTH_SIZE)[1] // 10 % 3 == 0
    for frame, mask in enumerate(truth.masks):
        shown = mask.copy()
        shown[:4, :4] = True
        images.write_gray(tmp_path / "foreground" / f"{frame:06d}.png", shown * np.uint8(255))
        depth = np.where(unknown, np.float32(0), clip.depth(frame))
        images.write_depth(tmp_path / "depth" / f"{frame:06d}.exr", depth)
    clip = replace(clip, scale=MAPPED)
    segmented = masks.segment(clip, tmp_path, "turnaround", None, OPTIONS, np.random.default_rng(0))
    found = [each.labels == 255 for each in segmented.masks]
    assert np.mean([iou(own, true) for own, true in zip(found, truth.masks, strict=True)]) > 0.94
    assert not any(own[:4, :4].any() for own in found), "foreground that nothing standing is part of"


def around(middle, radius_m, outward=False, count=12):
    """Return level cameras on a circle that face its center or away from it."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    away = np.stack([np.cos(angles), np.zeros(count), np.sin(angles)], axis=1)
    eyes = np.array(middle) + radius_m * away
    return np.stack(
        [
            scenery.rigid.look_at(eye, eye + (side if outward else -side), scenery.UP)
            for eye, side in zip(eyes, away, strict=True)
        ]
    )


@pytest.mark.parametrize(
    ("poses", "what"),
    [
        (scenery.rigid.make(np.eye(3), np.linspace([-0.3, 1.0, 0.0], [0.3, 1.0, 0.0], 12)), "one place"),
        (around((0.0, 1.0, 0.0), 0.0, outward=True), "one place"),
        (around((0.0, 1.0, 0.0), 0.3, outward=True), "one place"),
        (around((0.0, 2.0, 0.0), 0.9), "no level ground"),
    ],
    ids=["alongside", "on the spot", "outward", "at the ceiling"],
)
def test_turnaround_without_animal_is_refused(tmp_path, poses, what):
    _, agent = scenery.turnaround(len(poses))
    with pytest.raises(InputError, match=f"MSK-003.*{what}"):
        make(tmp_path / "frames", "turnaround", poses, agent, poses)


def test_recording_without_odometry_is_segmented(tmp_path):
    poses, agent = scenery.turnaround(40)
    flow = tmp_path / "flow"
    flow.mkdir()
    forward = np.zeros((39, scenery.COLOR_SIZE[0] // 4, scenery.COLOR_SIZE[1] // 4, 2), np.float16)
    npz.save(flow / "flow_1_fw.npz", flow=forward, confidence=np.zeros(forward.shape[:3], np.uint8))
    found, truth = make(tmp_path / "frames", "turnaround", poses, agent, None, flow)
    assert (
        np.mean([iou(mask.labels == 255, true) for mask, true in zip(found, truth.masks, strict=True)]) > 0.6
    )


def candidate(x, area=0.03):
    return Candidate(np.array([x, 0.0, 0.0]), area, 0.2)


def test_persistent_motion_is_preferred_to_larger_flashes():
    estimate_path = [[candidate(0.05 * i, 0.02)] for i in range(12)]
    for i in (3, 7):
        estimate_path[i].append(candidate(3.0 + i, 0.04))
    chosen = movers.track(estimate_path, np.arange(12) * 0.1, AnimalConfig())
    assert all(each is group[0] for each, group in zip(chosen, estimate_path, strict=True))


def test_prompt_selects_one_of_two_moving_objects():
    both = [[candidate(0.0, 0.05), candidate(2.0, 0.02)] for _ in range(10)]
    time = np.arange(10) * 0.1
    prompt = PlacedPrompt(4, np.array([2.0, 0.0, 0.0]))
    assert {each.area_m2 for each in movers.track(both, time, AnimalConfig())} == {0.05}
    assert {each.area_m2 for each in movers.track(both, time, AnimalConfig(), prompt)} == {0.02}


def test_prompt_applies_to_connected_tracks():
    """Visible, occluded for two frames, visible, absent for more than a second, another object at the same
    place or far away.
    """
    at = [0.1 * i for i in range(20)] + [None] * 12 + [2.0] * 8 + [4.0] * 10
    at[7:9] = [None, None]
    chosen, time = [None if x is None else candidate(x) for x in at], np.arange(len(at)) * 0.1

    def held(frame, x):
        return np.flatnonzero(
            movers.connected_to_prompt(
                chosen, time, AnimalConfig(), PlacedPrompt(frame, np.array([x, 0.0, 0.0]))
            )
        ).tolist()

    first = [*range(7), *range(9, 20)]
    assert held(3, 0.3) == held(8, 0.8) == first
    assert held(33, 2.0) == list(range(32, 40))
    assert held(45, 4.0) == list(range(40, 50))
    assert held(3, 3.0) == held(25, 2.0) == [], "elsewhere, or nothing seen then"


def click(mask, frame):
    """Return a click at the center of a true mask."""
    row, column = np.argwhere(mask)[mask.sum() // 2]
    return prompts.Prompt(frame, (column + 0.5, row + 0.5) * 2)


@pytest.mark.slow
def test_prompted_static_animal_is_segmented(tmp_path):
    poses, agent = scenery.session()
    agent = np.repeat(agent[20:21], 40, axis=0)
    truth = scenery.record(tmp_path / "frames", poses, agent, scenery.drifted(poses))
    clip, scores = Clip.open(tmp_path / "frames"), {}
    for prompt in (None, click(truth.masks[20], 20)):
        found = masks.segment(clip, Path("none"), "session", prompt, OPTIONS, np.random.default_rng(0)).masks
        scores[prompt] = [
            iou(mask.labels == 255, true) for mask, true in zip(found, truth.masks, strict=True)
        ]
    assert np.max(scores.pop(None)) == 0, "nothing moves"
    assert np.mean(*scores.values()) > 0.7


@pytest.mark.slow
def test_other_moving_object_does_not_replace_a_prompted_animal(tmp_path):
    """The animal leaves for good after 1.6 s; an object of similar size and another color moves all the
    time.
    """
    poses, agent = scenery.session()
    other = np.stack(
        [scenery.rigid.exp(np.array([0, 0, 0, 0.75, 0.22, z])) for z in np.linspace(-0.9, 0.2, 40)]
    )
    agent = np.stack(
        [scenery.rigid.exp(np.array([0, np.pi / 2, 0, x, 0.22, -0.2])) for x in np.linspace(-0.6, 0.1, 40)]
    )
    agent[16:] = np.nan
    truth = scenery.record(tmp_path / "frames", poses, agent, poses, world_from_other=other)
    clip, prompt = Clip.open(tmp_path / "frames"), click(truth.masks[8], 8)
    found = masks.segment(clip, Path("none"), "session", prompt, OPTIONS, np.random.default_rng(0)).masks
    found = list(found)
    assert (
        np.mean(
            [iou(mask.labels == 255, true) for mask, true in zip(found[:16], truth.masks[:16], strict=True)]
        )
        > 0.6
    )
    assert np.mean([mask.visible for mask in found[16:]]) < 0.2, "share of the frames without it"


def test_a_prompt_may_begin_with_a_byte_order_mark(tmp_path):
    poses, agent = scenery.turnaround(2)
    scenery.record(tmp_path / "frames", poses, agent, poses)
    (tmp_path / "prompt.toml").write_text("frame = 1\nclick = [0.5, 0.5]", "utf-8-sig")
    assert prompts.parse(tmp_path / "prompt.toml", Clip.open(tmp_path / "frames")).frame == 1


@pytest.mark.parametrize(
    "text",
    [
        "frame = 999\nclick = [3, 4]",
        "time_s = 99\nclick = [3, 4]",
        "frame = 0",
        "frame = 0\nbox = [5, 5, 900, 9]",
        "frame = 0\nclick = [3, 4]\nbox = [3, 4, 5, 6]",
        "frame = [",
        "frame = 0\nclick = 'x'",
        "frame = inf\nclick = [3, 4]",
        f"frame = {'9' * 400}\nclick = [3, 4]",
        f"time_s = {'9' * 400}\nclick = [3, 4]",
        f"frame = 0\nclick = [{'9' * 400}, 4]",
        "frame = 0\nbox = " + "[" * 5000 + "]" * 5000,
    ],
)
def test_invalid_prompt_is_refused(tmp_path, text):
    poses, agent = scenery.turnaround(2)
    scenery.record(tmp_path / "frames", poses, agent, poses)
    (tmp_path / "prompt.toml").write_text(text)
    with pytest.raises(InputError, match="MSK-001"):
        prompts.parse(tmp_path / "prompt.toml", Clip.open(tmp_path / "frames"))


def test_prompt_accepts_seconds_and_relative_coordinates(tmp_path):
    poses, agent = scenery.turnaround(3)
    scenery.record(tmp_path / "frames", poses, agent, poses)
    clip = Clip.open(tmp_path / "frames")
    passed_s = clip.timestamp_s[2] - clip.timestamp_s[0]
    (tmp_path / "prompt.toml").write_text(f"time_s = {passed_s}\nbox = [0.1, 0.25, 0.5, 1]")
    prompt = prompts.parse(tmp_path / "prompt.toml", clip)
    height, width = clip.color_size
    assert prompt == prompts.Prompt(2, (0.1 * width, 0.25 * height, 0.5 * width, height))


def test_click_is_placed_on_the_surface(tmp_path):
    poses, agent = scenery.turnaround(2)
    scenery.record(tmp_path / "frames", poses, agent, poses)
    clip = Clip.open(tmp_path / "frames")
    (tmp_path / "prompt.toml").write_text("frame = 1\nclick = [45, 60]")
    place = prompts.place(prompts.parse(tmp_path / "prompt.toml", clip), clip, poses).center_world
    assert np.linalg.norm(place - agent[0, :3, 3]) < 0.2, (
        "the middle of the picture shows the body, 14 cm thick"
    )


@pytest.mark.slow
def test_appearance_is_learned_despite_label_noise():
    """A striped object in front of noise; every seventh frame is labeled as background."""
    rng, examples, truths = np.random.default_rng(1), [], []
    for frame in range(28):
        color = rng.integers(90, 130, (96, 96, 3)).astype(np.uint8)
        top, left = rng.integers(8, 56, 2)
        color[top : top + 30, left : left + 30] = (np.arange(30) // 4 % 2 * 120 + 60)[:, None, None]
        truth = np.zeros((96, 96), bool)
        truth[top : top + 30, left : left + 30] = True
        truths.append(truth)
        elsewhere = np.roll(truth, 45, axis=1) & ~truth
        examples.append(
            Example(color, np.where(elsewhere if frame % 7 == 0 else truth, 255, 0).astype(np.uint8))
        )
    network = learn(examples, OPTIONS.learning, np.random.default_rng(0))
    again = learn(examples, OPTIONS.learning, np.random.default_rng(0))
    for example, truth in list(zip(examples, truths, strict=True))[::7]:
        assert iou(network.log_odds(example.color) > 0, truth) > 0.7
        np.testing.assert_array_equal(network.log_odds(example.color), again.log_odds(example.color))


def test_small_animals_weigh_more():
    counted, animal = torch.ones(2, 100, 100, dtype=torch.bool), torch.zeros(2, 100, 100, dtype=torch.bool)
    animal[0, :10, :10], animal[1, :50, :50] = True, True
    weight = appearance.balanced(counted, animal)
    assert weight[0][animal[0]].sum() == appearance.ANIMAL_SHARE * 100**2
    assert (weight[0][~animal[0]] == 1).all() and (weight[1] == 1).all()


def test_extrapolated_corners_are_consistent():
    labels = np.zeros((120, 160), np.uint8)
    labels[112:, 152:] = 255
    example, rng = Example(np.repeat(labels[..., None], 3, 2), labels), np.random.default_rng(0)
    for _ in range(50):
        zoomed, _ = appearance._rescaled(example, (119 + 53, 159 + 53), 144, 1.0, rng)
        assert (zoomed.labels == 255).any()


def test_recording_without_depth_requires_a_prompt(tmp_path):
    poses, agent = scenery.turnaround(2)
    scenery.record(tmp_path / "frames", poses, agent, poses)
    for path in (tmp_path / "frames" / "depth").iterdir():
        images.write_depth(path, np.zeros(scenery.DEPTH_SIZE))
    with pytest.raises(InputError, match="MSK-004"):
        masks.segment(
            Clip.open(tmp_path / "frames"), tmp_path, "session", None, OPTIONS, np.random.default_rng(0)
        )
