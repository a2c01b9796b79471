"""The estimated IoU is close to the true one, and the quality check fails only wrong masks."""

import importlib.util
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest

from pipeline.data.clips import Clip, Masks
from stages.segment_agent import free_space, overlap, writing
from stages.segment_agent.config import AnimalConfig
from stages.segment_agent.writing import Summary

_spec = importlib.util.spec_from_file_location(
    "room_with_animal", Path(__file__).parent.parent / "room_with_animal.py"
)
scenery = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenery)

THING, RADIUS_M = np.array([0.4, 0.0, 0.2]), 0.25
"""a part of the room that is mistaken for the animal, world, meters"""


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A session in which the animal walks, rests half of the time, and is absent at the end."""
    folder, (poses, agent) = tmp_path_factory.mktemp("session") / "frames", scenery.session()
    truth = scenery.record(folder, poses, agent, poses)
    clip = Clip.open(folder)
    return clip, poses, free_space.gather(clip, poses, 90), truth.masks


def judged(session, shown_px, what: overlap.Subject = "moving"):
    """Return the estimated mean IoU, the true one, and the status of the quality check."""
    clip, poses, references, true = session
    labels = [255 * each.astype(np.uint8) for each in shown_px]
    found = overlap.estimate(clip, poses, references, cast(Masks, labels), AnimalConfig(), what)
    area = shown_px.mean((1, 2))
    summary = Summary((area > 0).tolist(), [0.95] * len(area), area.tolist())
    status = {check.status for check in writing.checks_of(summary, 0.01, found)}
    union = (shown_px | true).sum((1, 2))
    iou = ((shown_px & true).sum((1, 2)) / np.maximum(union, 1))[union > 0].mean()
    return float(np.nanmean(found)), float(iou), status


def with_room(session):
    """Add a part of the room to all masks."""
    clip, poses, _, true = session
    points = [
        free_space.world_points(clip, frame, pose, clip.depth(frame), 1) for frame, pose in enumerate(poses)
    ]
    return true | (np.linalg.norm(np.stack(points) - THING, axis=-1) < RADIUS_M)


def while_it_rests(session):
    """Keep the masks of the middle half unchanged."""
    frames = np.arange(len(session[3]))[:, None, None]
    return session[3] & (frames > 14) & (frames < 26)


WRONG = {
    "a second late": lambda session: np.roll(session[3], 10, 0),
    "of another session": lambda session: session[3][::-1, :, ::-1],
    "with a part of the room": with_room,
    "with the floor around": lambda session: np.stack(
        [cv2.dilate(each.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0 for each in session[3]]
    ),
    "missing while it walks": while_it_rests,
}


def test_correct_masks_pass_also_at_rest(session):
    estimated, true, status = judged(session, session[3])
    assert true == 1
    assert estimated > 0.85, "feet within the noise of the floor are nobody's"
    assert status == {"ok"}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_masks_fail(session, wrong):
    estimated, true, status = judged(session, WRONG[wrong](session))
    assert true < 0.6
    assert estimated == pytest.approx(true, abs=0.2)
    assert "fail" in status
