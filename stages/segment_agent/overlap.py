"""How well finished masks overlap with the animal, estimated without truth.

The room is what references saw outside of all masks. In a mask, what others saw through is right; a surface
of the room, or what nobody saw through, is wrong. Outside, what goes somewhere by itself is lacking.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float

from pipeline.data.clips import Clip, Masks
from stages.segment_agent import free_space, locate, movers
from stages.segment_agent.config import AnimalConfig
from stages.segment_agent.free_space import References

Shown = Literal["mover", "rester", "one of several"]
"""what masks are of: an animal that moves; one that may rest all the time, so that only surfaces of the room
are wrong and nothing lacks; one beside others, of which nothing lacks"""


def estimate(
    clip: Clip,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    references: References,
    masks: Masks,
    animal: AnimalConfig,
    shown: Shown,
) -> Float[np.ndarray, "frame"]:
    """Return the estimated intersection over union of each frame; NaN where nothing is seen or lacking."""
    room = free_space.without(references, lambda frame: masks[frame] != 0)
    right_m2, whole_m2, lacking = np.zeros(len(clip)), np.zeros(len(clip)), []
    for frame, pose in enumerate(world_from_camera):
        inner = free_space.inner_depth(clip, frame)
        points, area_m2, chosen = free_space.sample(clip, frame, pose, inner, locate.COARSE_PX)
        labels = locate.sampled(masks[frame], clip.depth_size, chosen)
        votes = free_space.vote(room, points, frame)
        inside, right = labels == 255, movers.moving(votes)
        right |= (shown == "rester") & (votes.occupied == 0)
        right_m2[frame], whole_m2[frame] = (area_m2[own].sum() for own in (inside & right, inside))
        outside = locate.solid(votes, movers.SURE_SHARES[0]) & (labels == 0) & (shown == "mover")
        lacking.append(movers.candidates(outside, right, points, area_m2, animal))
    choice = movers.track(lacking, clip.timestamp_s, animal)
    chosen = [group[index] if index >= 0 else None for group, index in zip(lacking, choice, strict=True)]
    goes = movers.self_moving(chosen, clip.timestamp_s, animal)
    whole_m2 += [each.area_m2 if each and own else 0 for each, own in zip(chosen, goes, strict=True)]
    return np.where(whole_m2 < movers.MIN_AREA_M2, np.nan, right_m2 / np.maximum(whole_m2, 1e-9))
