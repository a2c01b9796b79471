"""The agent's own axes: origin in the middle of the body, +y up, +z towards the head."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry import rigid
from pipeline.geometry.ground import GroundPlane

END_SHARE = 0.18
"""Share of the body's length that counts as an end."""


@dataclass(frozen=True)
class Heading:
    """Heading of the body in the turnaround's world, and its evidence."""

    world_from_agent: Float[np.ndarray, "4 4"]
    head_share: float
    """share of the two ends' volume times height that lies at the end taken for the head's (0.5 =
    ambiguous)"""
    elongation: float
    """spread along the axis that was found against the spread across it, both level (1 = ambiguous)"""


def find_heading(inside_world: Float[np.ndarray, "cell 3"], ground: GroundPlane, turn_deg: float) -> Heading:
    """Lay +z along the longest level axis of the body, towards the end that holds more volume, higher up.

    The head is thick and high where the tail is thin or, curled up, the rump is low. Who stands upright or
    lies curled up may be wider than long: ``turn_deg``, counterclockwise from above, turns an answer that is
    wrong.
    """
    centre = np.median(inside_world, axis=0)
    level = (inside_world - inside_world.mean(0))[:, [0, 2]]
    variance, axes = np.linalg.eigh(level.T @ level)
    axis = axes[:, -1]
    axis = axis if axis[np.abs(axis).argmax()] > 0 else -axis
    along = (inside_world - centre)[:, [0, 2]] @ axis
    end = END_SHARE * np.ptp(along)
    height = np.maximum(ground.above(inside_world), 0)
    ahead, behind = height[along > along.max() - end].sum(), height[along < along.min() + end].sum()
    share = max(ahead, behind) / max(ahead + behind, 1e-9)
    if behind > ahead:
        axis = -axis
    up = np.array([0.0, 1.0, 0.0])
    forward = rigid.exp(np.r_[np.radians(turn_deg) * up, 0, 0, 0])[:3, :3] @ np.array([axis[0], 0, axis[1]])
    rotation = np.stack([np.cross(up, forward), up, forward], axis=1)
    return Heading(
        rigid.make(rotation, centre), float(share), float(np.sqrt(variance[1] / max(variance[0], 1e-12)))
    )
