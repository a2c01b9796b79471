"""Recognize the turnaround's animal in a session without depth, near what differs from the walk-through.

A difference is not always the animal: its shadow differs too, and where the map has holes nothing does.
"""

import numpy as np
from jaxtyping import Bool

from pipeline.segmentation.appearance import Appearance, strongest
from pipeline.segmentation.grabcut import dilated, sharpened
from stages.estimate_depth.foreground import ColorView

REACH_PX = 12
"""The animal is at most this far from foreground, pixels of small pictures: parts of it resemble the room."""


def recognize(
    network: Appearance,
    target: ColorView,
    in_front: Bool[np.ndarray, "height width"],
    rng: np.random.Generator,
) -> Bool[np.ndarray, "height width"]:
    """Return the animal's mask: of what is recognized near foreground, the part with the most evidence."""
    log_odds = network.log_odds(target.color)
    near = (log_odds > 0) & dilated(in_front, REACH_PX)
    return sharpened(target.color, strongest(near, log_odds), rng)
