"""Moving bodies of a session: `find_bodies` separates them at depth steps, `recognize` compares them with the
animals, `portrait` shows one of those beyond doubt, and `owners` says whose body each pixel belongs to.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import cv2
import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.data.clips import Clip
from pipeline.geometry import subsampling
from stages.segment_agent import free_space, movers
from stages.segment_agent.config import AnimalConfig
from stages.segment_agent.free_space import References
from stages.segment_agent.identity import Portrait
from stages.segment_agent.locate import COARSE_PX, AppearanceOf, opened_motion, resample_nearest
from stages.segment_agent.windows import STEP_M, working_picture, working_size

STEP_SHARE = 0.03
"""share of the depth by which neighboring samples of a surface may differ, beside `STEP_M`"""
MIN_BODY_M2, INNER = 0.01, (0.05, 0.95)
"""least visible area of a body: smaller ones are parts; quantiles of its points that its extent spans"""
CLEAR_LOG_ODDS, SURE_LOG_ODDS = 1.0, 2.2
"""mean log-odds from which a body clearly shows an animal, and from which (90 %) it is learned, and the
animal's as a whole: two animals that are one body have less"""
RIM = 2
"""distance from the picture's border that a whole body keeps, samples: of an animal's clear bodies in a
kitchen, 12 of 46 that are cut show another animal, none of 60 whole ones"""
MOVES, UNCLEAR = 255, -1
"""label of what moves and is no body; owner of pixels that are no sure body's"""
REACH = 0.05
"""distance from a body up to which thin parts are its own, as a share of the picture's height"""
MARGIN = np.ones((5, 5), np.uint8)
"""dilation of what moves, samples"""


@dataclass(frozen=True)
class Bodies:
    """Moving bodies of one frame on a grid of depth samples."""

    label: UInt8[np.ndarray, "row column"]
    """1, 2, ...: bodies, 255: what else moves, 0: the rest"""
    whole: Bool[np.ndarray, "body"]
    """not cut by the picture's border"""
    chosen: tuple[slice, slice]
    """the samples among the depth pixels"""
    log_odds: Float[np.ndarray, "animal body"]
    """that a body shows an animal and no other, the mean of its samples; -inf if this is not to be known"""


def find_bodies(
    clip: Clip,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    references: References,
    animal: AnimalConfig,
) -> list[Bodies]:
    """Separate the moving bodies of every frame that may be animals by their size."""
    found = []
    for frame, pose in enumerate(world_from_camera):
        depth = free_space.interior_depth(clip, frame)
        points, area, chosen = free_space.sample(clip, frame, pose, depth, COARSE_PX)
        votes = free_space.vote(references, points, frame)
        label, whole = np.where(movers.moving(votes), np.uint8(MOVES), np.uint8(0)), []
        for body in split_bodies(opened_motion(votes, movers.SURE_SHARES[-1]), depth[chosen]):
            extent_m = np.ptp(np.quantile(points[body], INNER, axis=0), axis=0).max()
            if area[body].sum() >= MIN_BODY_M2 and extent_m < animal.largest_m and len(whole) < MOVES - 1:
                whole.append(body[RIM:-RIM, RIM:-RIM].sum() == body.sum())
                label[body] = len(whole)
        found.append(Bodies(label, np.array(whole, bool), chosen, np.zeros((0, len(whole)))))
    return found


def split_bodies(
    moving: Bool[np.ndarray, "row column"], depth: Float[np.ndarray, "row column"]
) -> list[Bool[np.ndarray, "row column"]]:
    """Group moving samples that neighbors connect without a depth step: animals touch in the picture."""
    around = np.ones((3, 3), np.uint8)
    low = cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), around)
    whole = moving & (cv2.dilate(depth, around) - low < STEP_M + STEP_SHARE * low)
    count, label = cv2.connectedComponents(whole.astype(np.uint8), connectivity=4)
    size = np.bincount(label.ravel(), minlength=count)
    return [label == index for index in range(1, count) if size[index] >= movers.MIN_PIXELS]


def recognize(clip: Clip, found: Sequence[Bodies], margins: Sequence[AppearanceOf]) -> list[Bodies]:
    """Return the bodies with their log-odds, by those of each animal's pixels.

    Parts of a body often look like another animal; the whole rarely does.
    """
    recognized = []
    for frame, row in enumerate(found):
        log_odds, numbers = np.zeros((len(margins), len(row.whole))), range(1, len(row.whole) + 1)
        for animal, margin_of in enumerate(margins if numbers else ()):
            score = resample_nearest(margin_of(frame), clip.depth_size, row.chosen)
            log_odds[animal] = [score[row.label == number].mean() for number in numbers]
        recognized.append(replace(row, log_odds=log_odds))
    return recognized


def count(found: Sequence[Bodies]) -> Int[np.ndarray, "animal"]:
    """Return the number of frames in which a body clearly shows each animal."""
    return np.sum([(row.log_odds > CLEAR_LOG_ODDS).any(1) for row in found], axis=0)


def restricted(found: Sequence[Bodies], known: Bool[np.ndarray, "animal"]) -> list[Bodies]:
    """Return the bodies as if only ``known`` animals could be recognized."""
    return [replace(row, log_odds=np.where(known[:, None], row.log_odds, -np.inf)) for row in found]


def sure(found: Sequence[Bodies], animal: int, most: int) -> list[tuple[int, int]]:
    """Return up to ``most`` frames, and the label of the one whole body there that surely shows an animal."""
    shown = [(row.log_odds[animal] > SURE_LOG_ODDS) & row.whole for row in found]
    alone = np.flatnonzero([each.sum() == 1 for each in shown])
    chosen = alone[subsampling.evenly(len(alone), most)].tolist()
    return [(frame, 1 + int(shown[frame].argmax())) for frame in chosen]


def portrait(
    clip: Clip, found: Sequence[Bodies], height_px: int, animal: int, frame: int, number: int
) -> Portrait:
    """Return the picture of a body. What else moves is unknown, the rest is the room."""
    label, size = found[frame].label, working_size(clip, height_px)[::-1]
    moving = cv2.dilate((label > 0).astype(np.uint8), MARGIN) * np.uint8(128)
    labels = np.where(label == number, np.uint8(255), moving)
    labels = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)
    return Portrait(working_picture(clip, frame, height_px), labels, animal)


def owners(found: Bodies, size: tuple[int, int]) -> Int[np.ndarray, "height width"]:
    """Return the animal that each pixel's body surely shows, in a picture of ``size``; -1 elsewhere.

    Ears and tails, too thin to be in a body, belong to the nearest one.
    """
    if not len(found.whole):
        return np.full(size, UNCLEAR)
    shown = np.where(found.log_odds.max(0) > SURE_LOG_ODDS, found.log_odds.argmax(0), UNCLEAR)
    outside = (found.label == 0) | (found.label == MOVES)
    transform = scipy.ndimage.distance_transform_edt(outside, return_indices=True)
    distance, nearest = cast("tuple[np.ndarray, np.ndarray]", transform)
    label = np.where(distance <= REACH * len(outside), found.label[tuple(nearest)], 0)
    owner = np.insert(shown, 0, UNCLEAR)[label].astype(np.int16)
    return cv2.resize(owner, size[::-1], interpolation=cv2.INTER_NEAREST)
