"""People who walk through a session are detected and not mistaken for the animal."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from pipeline.data.clips import PEOPLE, Clip
from pipeline.geometry import rigid
from stages.segment_agent import masks, people, writing
from stages.segment_agent.config import Config, LearningConfig

_spec = importlib.util.spec_from_file_location(
    "room_with_animal", Path(__file__).parent.parent / "room_with_animal.py"
)
scenery = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenery)

OPTIONS = Config(learning=LearningConfig(examples=30, steps=60, batch=4, crop_px=96))


@pytest.fixture(scope="module")
def visited(tmp_path_factory):
    """A session with a person who walks behind the animal: its folder, ground truth and poses of the person."""
    poses, agent = scenery.session()
    along = np.linspace(-1.2, 1.2, len(poses))
    person = np.repeat(np.eye(4)[None], len(poses), axis=0)
    middle = np.nanmean(agent[:, :3, 3], axis=0)
    ahead = middle - poses[:, :3, 3].mean(0)
    ahead = ahead[[0, 2]] / np.linalg.norm(ahead[[0, 2]])
    person[:, 0, 3] = middle[0] + 0.6 * ahead[0] + along * ahead[1]
    person[:, 2, 3] = middle[2] + 0.6 * ahead[1] - along * ahead[0]
    folder = tmp_path_factory.mktemp("visited") / "frames"
    return (
        folder,
        scenery.record(
            folder, poses, agent, scenery.drifted(poses), world_from_other=person, other_body=scenery.person()
        ),
        person,
    )


@pytest.mark.slow
def test_person_is_separated_from_the_animal(visited, tmp_path):
    folder, truth, person = visited
    clip = Clip.open(folder)
    found = masks.segment(clip, Path("none"), "session", None, OPTIONS, np.random.default_rng(0))
    labels = np.stack([mask.labels for mask in found.masks])
    seen = truth.others.mean((1, 2)) > 0.03
    assert (labels[truth.others] == 255).mean() < 0.03, "of the person's pixels"
    assert (labels[truth.others] == 128).mean() > 0.6, "they are neither the animal nor the room"
    shown = truth.masks.mean((1, 2)) > 0.002
    score = [
        ((mask == 255) & true).sum() / ((mask == 255) | true).sum()
        for mask, true in zip(labels[shown], truth.masks[shown], strict=True)
    ]
    assert np.mean(score) > 0.6, "share; the pictures are 90 pixels wide"
    writing.write_people(tmp_path, clip, found)
    stored = PEOPLE.load(tmp_path / "people.npz")
    assert stored["feet_camera"].shape == (len(clip), 1, 3)
    true = rigid.apply(rigid.inverse(truth.world_from_camera), person[:, None, :3, 3])[:, 0]
    off = np.linalg.norm(stored["feet_camera"][:, 0] - true, axis=-1)
    assert np.isfinite(off[seen]).mean() > 0.7, "share of the frames that show the person"
    assert np.nanmedian(off) < 0.1, "meters"


def test_person_who_walks_has_a_place_a_height_and_a_heading(visited):
    folder, truth, person = visited
    clip = Clip.open(folder)
    _, found = people.gather_without_people(clip, truth.world_from_camera, 40)
    assert len(found.axis_world) == 1
    off = np.linalg.norm(found.axis_world[0] - person[:, ::2, 3][:, :2], axis=-1)
    assert np.nanmedian(off) < 0.1, "meters"
    way = person[-1, ::2, 3] - person[0, ::2, 3]
    cosine = found.ahead_world[0] @ (way / np.linalg.norm(way))
    known = np.isfinite(cosine)
    assert known.sum() > 0.5 * np.isfinite(off).sum()
    assert np.median(cosine[known]) > np.cos(np.radians(15))


def test_heading_of_a_person_who_stands_is_unknown():
    rng, time = np.random.default_rng(0), np.arange(100) / 10
    place = np.stack([np.clip(time - 5, 0, None), 0 * time], axis=-1)
    ahead = people.walking_direction(place + 0.03 * rng.standard_normal(place.shape), time)
    assert np.isnan(ahead[:45]).mean() > 0.9 and np.isfinite(ahead[55:]).all()
    assert np.degrees(np.abs(np.arctan2(ahead[55:, 1], ahead[55:, 0]))).max() < 15
    place[70:] = np.nan
    assert np.isnan(people.walking_direction(place, time)[70:]).all(), "who is not seen"


def test_no_people_are_found_without_people(tmp_path):
    poses, agent = scenery.session()
    scenery.record(tmp_path / "frames", poses, agent, poses)
    references, walkers = people.gather_without_people(Clip.open(tmp_path / "frames"), poses, 40)
    assert walkers.axis_world.shape == (0, len(poses), 2)
    assert references.ignored is None
    assert not walkers.near(0, np.zeros((3, 3))).any()
