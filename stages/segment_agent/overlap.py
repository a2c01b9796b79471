"""Estimate the IoU of finished masks without ground truth.

The room is what references saw outside of all masks. In a mask, points that others saw through are true
positives; static surfaces and unseen space are false positives. What moves by itself outside is missed.
"""

from functools import partial
from typing import Literal

import numpy as np
from jaxtyping import Float

from pipeline.data.clips import Clip, Masks
from stages.segment_agent import free_space, locate, movers
from stages.segment_agent.config import AnimalConfig
from stages.segment_agent.free_space import References

Subject = Literal["moving", "resting", "one of several"]
"""what masks are of: a moving animal; one that may rest all the time, so that unseen space is right; one of
several, which were recognized, so that unseen space does not count. Only the first has false negatives"""
EVERY = 2
"""every how many frames are evaluated: masks of consecutive frames err alike"""


def estimate(
    clip: Clip,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    references: References,
    masks: Masks,
    animal: AnimalConfig,
    shown: Subject,
) -> Float[np.ndarray, "evaluated_frame"]:
    """Return the estimated IoU of every `EVERY`-th frame; NaN where nothing is seen or missed."""
    room = free_space.masked(references, lambda frame: masks[frame] != 0)
    intersection_m2, union_m2, missing = [], [], []
    evaluated = range(0, len(clip), EVERY)
    for frame in evaluated:
        pose = world_from_camera[frame]
        inner = free_space.interior_depth(clip, frame)
        points, area_m2, chosen = free_space.sample(clip, frame, pose, inner, locate.COARSE_PX)
        labels = locate.resample_nearest(masks[frame], clip.depth_size, chosen)
        votes = free_space.vote(room, points, frame)
        through = partial(free_space.seen_through, room, frame=frame)
        moves = movers.moving(votes)
        moves &= (labels != 255) | through(points[moves & (labels == 255)])
        right = moves | ((shown == "resting") & (votes.occupied == 0))
        seen = (shown != "one of several") | (votes.free + votes.occupied > 0)
        inside = (labels == 255) & (right | seen)
        intersection_m2.append(area_m2[inside & right].sum())
        union_m2.append(area_m2[inside].sum())
        outside = locate.opened_motion(votes, movers.SURE_SHARES[0]) & (labels == 0) & (shown == "moving")
        missing.append(movers.candidates(outside, right, points, area_m2, animal, through))
    time_s = clip.timestamp_s[::EVERY]
    chosen = movers.track(missing, time_s, animal)
    self_moving = movers.self_moving(chosen, time_s, animal)
    false_negative_m2 = [
        each.area_m2 if each and own else 0 for each, own in zip(chosen, self_moving, strict=True)
    ]
    union = np.array(union_m2) + false_negative_m2
    return np.where(union < movers.MIN_AREA_M2, np.nan, np.array(intersection_m2) / np.maximum(union, 1e-9))
