"""Carry the mask of one frame through a recording without depth.

The log-odds of all pixels of all frames are a mean field (Krahenbuhl and Koltun 2011), updated frame by
frame, forward and back. The unary is the mean of two networks of `appearance`, of which one sees motion
against the background beside the colors. Messages come from the frames 1, 2, 4 and 8 before and after along
the flow, as far as its two directions agree, and from neighbors in the picture up to its edges (domain
transform, Gastal and Oliveira 2011). The networks learn from the one mask, then from all frames where motion
does not contradict. They correct the first mask, too, within the hinted box.
"""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.data.flow import GAPS
from pipeline.geometry import subsampling
from stages.segment_agent.appearance import Example, learn
from stages.segment_agent.config import LearningConfig
from stages.segment_agent.footage import REACH_PX, Footage, grown, pixels

SURE, MIN = 4.0, 0.5
"""largest and smallest log-odds of a pixel; the largest of the network's judgement too"""
MESSAGE, SMOOTHING = 0.6, 4.0
"""weights of messages in time (log-odds) and in the picture (-1..1)"""
DOUBT = 0.15
"""confidence of flow that is worth half a message"""
SPATIAL_PX, EDGE = 10.0, 25.0
"""reach of messages, working pixels as all here, and the change of color (of 255) that stops them"""
CONNECTED = 0.1
"""share of what its main part holds of the carried mask that another part must hold to stay"""
CERTAIN, HINTED_SHARE = 2.0, 0.17
"""log-odds from which on a pixel is learned from; share of the hinted frame among the examples"""
CROP_PX, STEPS = 112, (80, 120, 120)
"""side of the crops that are learned from; training steps on the hinted frame, on all, and again"""

LogOdds = Float[np.ndarray, "height width"]
Labels = list[LogOdds | None]
"""log-odds by frame; None where nothing is known yet"""
Picture = Callable[[int], UInt8[np.ndarray, "height width channel"]]


def propagate(
    footage: Footage, hinted: int, first: LogOdds, learning: LearningConfig, rng: np.random.Generator
) -> list[LogOdds]:
    """Return log-odds of the animal in all frames from ``first`` in one, -`SURE` where it cannot be."""
    frames = range(len(footage.clip))
    found: Labels = [None for _ in frames]
    found[hinted], possible = first, first > MIN - SURE
    forward = [*frames[hinted + 1 :], *frames[:hinted][::-1]]
    for turn, steps in enumerate(STEPS):
        options = replace(learning, steps=steps, crop_px=CROP_PX)
        judged = np.zeros((len(frames), *footage.size), np.float16)
        for picture in (footage.color, footage.with_motion):
            shown = examples(footage, found, hinted, learning.examples, picture)
            network = learn(shown, options, rng, min_px=1, scaled=0.0)
            assert network is not None, "the hinted frame shows the animal"
            for frame in frames:
                judged[frame] += network.log_odds(picture(frame)) / 2
        judged[hinted][~possible] = -np.inf
        for frame in [*(forward[::-1] if turn else []), *forward, hinted]:
            found[frame] = updated(footage, frame, judged[frame], found)
    return [each.astype(np.float32) for each in found if each is not None]


def examples(footage: Footage, found: Labels, hinted: int, count: int, picture: Picture) -> list[Example]:
    """Label so many pictures of frames, evenly chosen, as far as they are sure and motion does not
    contradict; the hinted one is repeated."""
    chosen = subsampling.evenly(len(found), count, rounded=True).tolist()
    shown = []
    for frame in (hinted, *(each for each in chosen if each != hinted)):
        log_odds = found[frame]
        if log_odds is not None:
            sure = (np.abs(log_odds) >= CERTAIN) & (log_odds * footage.moving(frame, log_odds > 0) >= 0)
            labels = np.where(sure, np.where(log_odds > 0, 255, 0), 128)
            shown.append(Example(picture(frame), labels.astype(np.uint8)))
    return shown[:1] * max(1, round(HINTED_SHARE * len(chosen))) + shown[1:]


def updated(footage: Footage, frame: int, judged: LogOdds, found: Labels) -> LogOdds:
    """Update one frame from what the networks make of it and messages; only what is connected with the
    carried mask stays."""
    carried = message(footage, frame, found)
    seen = bool((carried > 0).any())
    near = (grown(carried > 0, REACH_PX) | (not seen)) & (judged != -np.inf)
    log_odds = np.clip(judged, -SURE, SURE).astype(np.float32) + MESSAGE * carried
    log_odds = np.where(near, log_odds, -SURE)
    around = cv2.ximgproc.dtFilter(
        footage.color(frame), np.tanh(log_odds / 2), SPATIAL_PX, EDGE, mode=cv2.ximgproc.DTF_RF
    )
    log_odds = np.where(near, log_odds + SMOOTHING * around, -SURE)
    inside = connected(log_odds > 0, carried > 0 if seen else log_odds > 0)
    low, high = np.where(inside, MIN, -SURE), np.where(inside, SURE, -MIN)
    return np.clip(log_odds, low, high).astype(np.float16)


def message(footage: Footage, frame: int, found: Labels) -> LogOdds:
    """Return the mean of the log-odds that flow brings from other frames, weighted by its confidence."""
    size = footage.size
    total, weight = np.zeros(size, np.float32), np.full(size, DOUBT, np.float32)
    for other in (frame + way * gap for gap in GAPS for way in (-1, 1)):
        labels = found[other] if 0 <= other < len(found) else None
        moved = None if labels is None else footage.to(frame, other)
        if labels is None or moved is None:
            continue
        confidence, labels = footage.confidence(frame, other), labels.astype(np.float32)
        x, y = np.moveaxis(pixels(size) + moved, -1, 0)
        brought = cv2.remap(labels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        total += confidence * brought
        weight += confidence
    return total / weight


def connected(
    inside: Bool[np.ndarray, "height width"], carried: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Keep the parts that meet the carried mask."""
    count, part = cv2.connectedComponents(inside.astype(np.uint8))
    met = np.bincount(part[carried & inside], minlength=count)
    return ((met > CONNECTED * met.max()) & (met > 0))[part]
