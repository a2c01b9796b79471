"""Propagate the mask of one frame through a recording without depth.

The log-odds of all pixels of all frames are a mean field (Krahenbuhl and Koltun 2011), updated frame by
frame, forward and back. The unary is the mean of four networks of `appearance`, of which two see motion
against the background beside the colors. Messages come from the frames 1, 2, 4 and 8 before and after along
the flow, as far as its two directions agree, and from neighbors in the picture up to its edges (domain
transform, Gastal and Oliveira 2011). The networks learn from the one mask, then from all frames where motion
does not contradict. They correct the first mask, too, within the prompt's box.
"""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.data.flow import GAPS
from pipeline.geometry import cameras, subsampling
from pipeline.segmentation.appearance import Example, learn
from pipeline.segmentation.config import LearningConfig
from pipeline.segmentation.grabcut import Region, dilated
from stages.segment_agent.footage import SEARCH_PX, Footage

MAX_LOG_ODDS, MIN_LOG_ODDS = 4.0, 0.5
"""largest and smallest magnitude of a pixel's log-odds"""
TEMPORAL_WEIGHT, SPATIAL_WEIGHT = 0.6, 4.0
"""weights of temporal messages (log-odds) and spatial messages (-1..1)"""
DOUBT = 0.15
"""flow confidence at which a message has half its weight"""
SPATIAL_PX, EDGE = 10.0, 25.0
"""spatial (working pixels) and range (of 255) standard deviation of the domain transform"""
CONNECTED = 0.1
"""overlap with the propagated mask that a component needs, as a share of the largest overlap"""
CERTAIN, PROMPTED_SHARE = 2.0, 0.17
"""log-odds of training pixels; share of the prompted frame among the examples"""
CROP_PX, STEPS = 112, (80, 120, 120)
"""side of training crops; training steps on the prompted frame, on all, and again on all"""
NETWORKS = 2
"""networks per kind of picture, which are averaged: masks by single ones depend on their initial weights"""

LogOdds = Float[np.ndarray, "height width"]
Beliefs = list[LogOdds | None]
"""log-odds by frame; None where nothing is known yet"""
Picture = Callable[[int], UInt8[np.ndarray, "height width channel"]]


def propagate(
    footage: Footage, prompted: int, first: LogOdds, learning: LearningConfig, rng: np.random.Generator
) -> list[LogOdds]:
    """Return log-odds of the animal in all frames, given ``first`` in the prompted one."""
    frames = range(len(footage.clip))
    found: Beliefs = [None for _ in frames]
    found[prompted], possible = first, first > MIN_LOG_ODDS - MAX_LOG_ODDS
    forward = [*frames[prompted + 1 :], *frames[:prompted][::-1]]
    for iteration, steps in enumerate(STEPS):
        options = replace(learning, steps=steps, crop_px=CROP_PX)
        unary = np.zeros((len(frames), *footage.size), np.float16)
        for picture in (footage.color,) * NETWORKS + (footage.with_motion,) * NETWORKS:
            shown = examples(footage, found, prompted, learning.examples, picture)
            network = learn(shown, options, rng, min_px=1, scaled=0.0)
            assert network is not None, "the prompted frame shows the animal"
            for frame in frames:
                unary[frame] += network.log_odds(picture(frame)) / (2 * NETWORKS)
        unary[prompted][~possible] = -np.inf
        for frame in [*(forward[::-1] if iteration else []), *forward, prompted]:
            found[frame] = update_frame(footage, frame, unary[frame], found)
    return [each.astype(np.float32) for each in found if each is not None]


def examples(footage: Footage, found: Beliefs, prompted: int, count: int, picture: Picture) -> list[Example]:
    """Return ``count`` evenly spaced training examples, and the prompted one repeatedly; pixels that are
    uncertain or contradicted by motion are unknown."""
    chosen = subsampling.evenly(len(found), count, rounded=True).tolist()
    shown = []
    for frame in (prompted, *(each for each in chosen if each != prompted)):
        log_odds = found[frame]
        if log_odds is not None:
            sure = (np.abs(log_odds) >= CERTAIN) & (log_odds * footage.moving(frame, log_odds > 0) >= 0)
            labels = np.where(sure, np.where(log_odds > 0, 255, 0), 128)
            shown.append(Example(picture(frame), labels.astype(np.uint8)))
    return shown[:1] * max(1, round(PROMPTED_SHARE * len(chosen))) + shown[1:]


def update_frame(footage: Footage, frame: int, unary: LogOdds, found: Beliefs) -> LogOdds:
    """Update one frame from its unary and messages; keep only what is connected to the propagated mask."""
    propagated = message(footage, frame, found)
    seen = bool((propagated > 0).any())
    near = (dilated(propagated > 0, SEARCH_PX) | (not seen)) & (unary != -np.inf)
    log_odds = np.clip(unary, -MAX_LOG_ODDS, MAX_LOG_ODDS).astype(np.float32) + TEMPORAL_WEIGHT * propagated
    log_odds = np.where(near, log_odds, -MAX_LOG_ODDS)
    around = cv2.ximgproc.dtFilter(
        footage.color(frame), np.tanh(log_odds / 2), SPATIAL_PX, EDGE, mode=cv2.ximgproc.DTF_RF
    )
    log_odds = np.where(near, log_odds + SPATIAL_WEIGHT * around, -MAX_LOG_ODDS)
    inside = connected(log_odds > 0, propagated > 0 if seen else log_odds > 0)
    low, high = np.where(inside, MIN_LOG_ODDS, -MAX_LOG_ODDS), np.where(inside, MAX_LOG_ODDS, -MIN_LOG_ODDS)
    return np.clip(log_odds, low, high).astype(np.float16)


def message(footage: Footage, frame: int, found: Beliefs) -> LogOdds:
    """Return the mean of other frames' log-odds warped by flow, weighted by flow confidence."""
    size = footage.size
    total, weight = np.zeros(size, np.float32), np.full(size, DOUBT, np.float32)
    for other in (frame + sign * gap for gap in GAPS for sign in (-1, 1)):
        labels = found[other] if 0 <= other < len(found) else None
        moved = None if labels is None else footage.flow_between(frame, other)
        if labels is None or moved is None:
            continue
        confidence, labels = footage.confidence(frame, other), labels.astype(np.float32)
        x, y = np.moveaxis((cameras.pixel_grid(*size) - 0.5 + moved).astype(np.float32), -1, 0)
        warped = cv2.remap(labels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        total += confidence * warped
        weight += confidence
    return total / weight


def connected(inside: Region, propagated: Region) -> Region:
    """Keep the connected components that overlap the propagated mask."""
    count, component = cv2.connectedComponents(inside.astype(np.uint8))
    overlap_px = np.bincount(component[propagated & inside], minlength=count)
    return ((overlap_px > CONNECTED * overlap_px.max()) & (overlap_px > 0))[component]
