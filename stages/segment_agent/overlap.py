"""Estimate the IoU of finished masks without ground truth.

The room is what references saw outside of all masks. In a mask, points that others saw through are true
positives; static surfaces and unseen space are false positives. What moves by itself outside is missed.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float

from pipeline.data.clips import Clip, Masks
from stages.segment_agent import free_space, locate, movers
from stages.segment_agent.config import AnimalConfig
from stages.segment_agent.free_space import References

Subject = Literal["moving", "resting", "one of several"]
"""what masks are of: a moving animal; one that may rest all the time, so that unseen space is right; one of
several. Only the first has false negatives"""


def estimate(
    clip: Clip,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    references: References,
    masks: Masks,
    animal: AnimalConfig,
    shown: Subject,
) -> Float[np.ndarray, "frame"]:
    """Return the estimated intersection over union of each frame; NaN where nothing is seen or missed."""
    room = free_space.masked(references, lambda frame: masks[frame] != 0)
    intersection_m2, union_m2, missing = np.zeros(len(clip)), np.zeros(len(clip)), []
    for frame, pose in enumerate(world_from_camera):
        inner = free_space.interior_depth(clip, frame)
        points, area_m2, chosen = free_space.sample(clip, frame, pose, inner, locate.COARSE_PX)
        labels = locate.resample_nearest(masks[frame], clip.depth_size, chosen)
        votes = free_space.vote(room, points, frame)
        inside, right = labels == 255, movers.moving(votes)
        right |= (shown == "resting") & (votes.occupied == 0)
        intersection_m2[frame], union_m2[frame] = (area_m2[own].sum() for own in (inside & right, inside))
        outside = locate.opened_motion(votes, movers.SURE_SHARES[0]) & (labels == 0) & (shown == "moving")
        missing.append(movers.candidates(outside, right, points, area_m2, animal))
    choice = movers.track(missing, clip.timestamp_s, animal)
    chosen = [group[index] if index >= 0 else None for group, index in zip(missing, choice, strict=True)]
    self_moving = movers.self_moving(chosen, clip.timestamp_s, animal)
    union_m2 += [each.area_m2 if each and own else 0 for each, own in zip(chosen, self_moving, strict=True)]
    return np.where(union_m2 < movers.MIN_AREA_M2, np.nan, intersection_m2 / np.maximum(union_m2, 1e-9))
