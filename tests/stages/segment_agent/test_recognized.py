"""Masks of a session whose depth comes from the map: by the recognizer, since its depth proves nothing."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.data import images
from pipeline.data.clips import MAPPED, Clip
from pipeline.segmentation.appearance import Appearance, strongest
from pipeline.segmentation.recognizer import small
from stages.segment_agent import free_space, locate, masks
from stages.segment_agent.config import Config, LearningConfig
from stages.segment_agent.windows import working_size
from tests.stages import room_with_animal as scenery

SHORT = Config(learning=LearningConfig(examples=30, steps=60, batch=4, crop_px=96))
POSTER = np.s_[2:14, 70:88]
"""Part of the wall with the animal's color."""


class KnownColor(Appearance):
    """Recognizes the animal by its color."""

    def __init__(self, most=4.0):
        super().__init__()
        self.most = most

    def log_odds(self, color):
        """Return the most where the color is the animal's, -4 elsewhere."""
        away = np.linalg.norm(color.astype(np.float32) - scenery.ANIMAL_COLOR, axis=-1)
        return np.where(away < 40, self.most, -4).astype(np.float32)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A session in which depth shows only the animal's upper half, and a block of floor beside it too."""
    folder = tmp_path_factory.mktemp("recognized") / "frames"
    poses, agent = scenery.session()
    truth = scenery.record(folder, poses, agent, poses)
    empty = scenery.record(folder.parent / "empty", poses, np.full_like(agent, np.nan), poses)
    assert not empty.masks.any()
    for frame, mask in enumerate(truth.masks):
        depth = images.read_depth(folder / f"depth/{frame:06d}.exr")
        room = images.read_depth(folder.parent / f"empty/depth/{frame:06d}.exr")
        rows, columns = np.nonzero(mask)
        if len(rows):
            lower = mask & (np.arange(len(mask))[:, None] > rows.mean())
            beside = np.s_[int(rows.mean()) : rows.max() + 1, columns.max() + 1 : columns.max() + 9]
            wrong = np.where(lower, room, depth)
            wrong[beside] = np.median(depth[mask])
            images.write_depth(folder / f"depth/{frame:06d}.exr", wrong)
        color = images.read_color(folder / f"color/{frame:06d}.jpg")
        color[POSTER] = scenery.ANIMAL_COLOR
        images.write_color(folder / f"color/{frame:06d}.jpg", color, 95)
    return Clip.open(folder), truth.masks


def overlaps(session, recognizer):
    clip, truth = session
    found = masks.segment(clip, clip.folder, "session", None, SHORT, np.random.default_rng(0), recognizer)
    pairs = [(mask.labels, true) for mask, true in zip(found.masks, truth, strict=True) if true.any()]
    assert not any((labels[POSTER] == 255).any() for labels, _ in pairs), "not the poster of the same color"
    known = [((labels == 255) & true, ((labels == 255) | true) & (labels != 128)) for labels, true in pairs]
    return np.array([both.sum() / either.sum() for both, either in known])


@pytest.mark.slow
def test_what_is_recognized_is_segmented_where_depth_is_wrong(session):
    recognized, relearned = overlaps(session, KnownColor()), overlaps(session, None)
    assert recognized.mean() > 0.78, "share of known pixels; the pictures are 90 pixels wide"
    assert recognized.mean() > relearned.mean() + 0.1
    assert overlaps(session, KnownColor(1.5)).mean() > 0.6, "hardly recognized, but tracked"


def test_hardly_recognized_animals_at_rest_are_found_where_the_picture_differs_from_the_map(tmp_path):
    """Nobody sees through an animal that rests all the time: only its picture differs."""
    poses, agent = scenery.session()
    truth = scenery.record(tmp_path, poses, np.repeat(agent[len(agent) // 3][None], len(agent), 0), poses)
    clip, recognizer = Clip.open(tmp_path), KnownColor(0.3)
    references = free_space.gather(clip, poses, SHORT.references)
    in_view = np.array([mask.sum() > 40 for mask in truth.masks])

    def found():
        spheres = locate.find_mover(
            clip, poses, references, SHORT.animal, None, lambda frame: recognizer.log_odds(clip.color(frame))
        )
        return np.array([each is not None and not each.presumed for each in spheres])

    assert in_view.sum() > 10 and not found().any()
    clip = replace(clip, scale=MAPPED)
    (tmp_path / "foreground").mkdir()
    for frame, mask in enumerate(truth.masks):
        images.write_gray(tmp_path / "foreground" / f"{frame:06d}.png", mask * np.uint8(255))
    assert found()[in_view].mean() > 0.8 and not found()[~in_view].any()


def test_only_the_strongest_component_is_the_animal():
    inside, log_odds = np.zeros((20, 30), bool), np.full((20, 30), -4.0)
    inside[2:12, 2:10], log_odds[2:12, 2:10] = True, 3.0
    inside[5:18, 15:28], log_odds[5:18, 15:28] = True, 0.5
    found = strongest(inside, log_odds)
    assert found[2:12, 2:10].all() and found.sum() == 80
    assert not strongest(np.zeros_like(inside), log_odds).any()


@pytest.mark.parametrize("size", [(480, 640), (640, 360), (120, 90)], ids=["landscape", "portrait", "tiny"])
def test_animals_are_recognized_at_the_scale_of_training(session, size, monkeypatch):
    """Whichever way the phone is held, the shorter side is that of `small`."""
    clip = replace(session[0], color_size=size)
    monkeypatch.setattr(masks, "find_mover", lambda *_: [None] * len(clip))
    monkeypatch.setattr(masks.free_space, "masked", lambda *_: None)
    found = masks._recognized_segmenter(clip, None, None, Config(), KnownColor(), np.random.default_rng(0))
    assert working_size(clip, found.height_px) == small(np.zeros((*size, 3), np.uint8)).shape[:2]
