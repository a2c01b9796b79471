"""The animal's heading over time, by Viterbi decoding over a grid of headings.

Depth hardly distinguishes front from back, and every fit is off by some degrees; but animals turn smoothly
and walk head first. The head end of the template is guessed from shape, and reversed if the recording clearly
shows the animal walking the other way. Frames that show little, fit badly or repeat earlier views have low
weight.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry import rigid, viterbi

HEADINGS = 36
"""Number of grid headings: steps of 10 degrees."""
GRID_RAD = 2 * np.pi * np.arange(HEADINGS) / HEADINGS - np.pi
HEADING_SIGMA_DEG, MAX_FRAME_COST = 20.0, 12.0
"""Heading difference between hypothesis and grid that costs one unit, and largest cost of one frame."""
MOTION_WEIGHT, WALKING = 4.0, (0.417, 1)
"""Cost of walking tail first, ramping up between these speeds, body lengths per second: the center of visible
points also moves when an animal turns on the spot."""
REVERSED_SHARE = 0.6
"""The template's head and tail are swapped if that saves this share of the cost of always walking tail first,
and more than `FLIP_COST`."""
TURN_DEG, TURN_S, FLIP_COST = 30.0, 0.1, 40.0
"""Turn (degrees) within a time (seconds) that costs one unit, and the largest cost of a turn."""
STILL_WEIGHT, NEW_VIEW_M_S, CAMERA_SHARE = 0.06, 0.4, 0.5
"""Weight of a frame in which neither animal nor phone moves, speed of full weight (m/s), and weight of the
phone's speed in it."""
ENOUGH_SHARE, MISFIT_SCALE = 0.2, 6.0
"""Visible share of full weight, and excess of the best hypothesis' cost over the median that halves the
weight, units."""
NEAR_DEG = 50.0
"""Difference from a heading, degrees, within which the true one counts as found."""
MIN_SPAN_S, MAX_SPAN_S = 0.15, 1.2
"""Range of time differences over which velocities are measured, seconds."""


@dataclass(frozen=True)
class RootHypotheses:
    """Pose hypotheses of one frame and their costs, in units."""

    frame: int
    world_from_agent: Float[np.ndarray, "hypothesis 4 4"]
    cost: Float[np.ndarray, "hypothesis"]
    min_misfit: float
    """Cost of the best pose by shape and color alone."""
    share: float
    """Visible share, 0..1."""
    center_world: Float[np.ndarray, "3"]
    """Median of the visible points."""
    eye_world: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Headings:
    """The animal's heading over time."""

    likeliest_rad: Float[np.ndarray, "observation"]
    probability: Float[np.ndarray, "observation heading"]
    """Of `HEADINGS` grid headings."""

    def probability_near(
        self, heading_rad: Float[np.ndarray, "observation"]
    ) -> Float[np.ndarray, "observation"]:
        """Return the probability that the heading is about this one."""
        near = np.abs(rigid.wrap(GRID_RAD - heading_rad[:, None])) < np.deg2rad(NEAR_DEG)
        return (self.probability * near).sum(1)


def choose_hypotheses(candidates: list[RootHypotheses], headings: Headings) -> list[int]:
    """Choose the hypothesis of least cost per frame, including its difference from the decoded heading."""
    pairs = zip(candidates, headings.likeliest_rad, strict=True)
    return [int(_heading_cost(each, angle).argmin()) for each, angle in pairs]


def decode_headings(
    timestamp_s: Float[np.ndarray, "frame"], candidates: list[RootHypotheses], length_m: float
) -> Headings:
    """Return the most likely heading of each observation, by Viterbi decoding, and how likely each is.

    Decodes once for an animal of ``length_m`` that walks along its template's +z and once for -z.
    """
    (velocity, novelty), weight = motion_cues(timestamp_s, candidates), weights(candidates)
    slow, fast = length_m * np.array(WALKING)
    walks = np.clip((np.hypot(*velocity[:, [0, 2]].T) - slow) / (fast - slow), 0, 1)
    walking = MOTION_WEIGHT * weight * walks
    visual = np.stack([_heading_cost(each, GRID_RAD[:, None]).min(1) for each in candidates])
    visual = novelty[:, None] * np.minimum(visual - visual.min(1, keepdims=True), MAX_FRAME_COST)
    turn = (rigid.wrap(GRID_RAD[:, None] - GRID_RAD[None]) / np.deg2rad(TURN_DEG)) ** 2

    def turn_cost(index: int) -> Float[np.ndarray, "before after"]:
        elapsed_s = timestamp_s[candidates[index].frame] - timestamp_s[candidates[index - 1].frame]
        tenths = max(elapsed_s / TURN_S, 1.0)
        return np.minimum(turn / tenths, FLIP_COST / np.sqrt(tenths))

    def decoded(direction: float) -> tuple[np.ndarray, np.ndarray, float]:
        opposition = 1 - direction * np.cos(GRID_RAD - np.arctan2(*velocity[:, [0, 2]].T)[:, None])
        unary = weight[:, None] * visual + walking[:, None] * opposition / 2
        state = viterbi.viterbi_decode(unary, turn_cost)
        turns = sum(turn_cost(index)[state[index - 1], state[index]] for index in range(1, len(state)))
        return unary, state, float(unary[np.arange(len(state)), state].sum() + turns)

    (*head_first, cost), (*tail_first, reversed_cost) = decoded(1.0), decoded(-1.0)
    margin = max(FLIP_COST, REVERSED_SHARE * walking.sum())
    unary, state = tail_first if cost - reversed_cost > margin else head_first
    return Headings(GRID_RAD[state], viterbi.marginals(unary, turn_cost))


def weights(candidates: list[RootHypotheses]) -> Float[np.ndarray, "observation"]:
    """Return the weight of each frame, 0..1, by visible share and misfit."""
    misfit, share = (
        np.array([getattr(each, name) for each in candidates]) for name in ("min_misfit", "share")
    )
    excess = np.maximum(misfit - np.median(misfit), 0) / MISFIT_SCALE
    return np.minimum(share / ENOUGH_SHARE, 1.0) / (1 + excess**2)


def motion_cues(
    timestamp_s: Float[np.ndarray, "frame"], candidates: list[RootHypotheses]
) -> tuple[Float[np.ndarray, "observation 3"], Float[np.ndarray, "observation"]]:
    """Measure motion between the third observations before and after each one.

    Returns the horizontal velocity of the visible points' median, m/s, zero across gaps, and how much new a
    frame shows, 0..1: errors of repeated views are correlated.
    """
    center = np.stack([each.center_world for each in candidates]) * (1, 0, 1)
    camera = np.stack([each.eye_world for each in candidates])
    time = timestamp_s[[each.frame for each in candidates]]
    before = np.maximum(np.arange(len(time)) - 3, 0)
    after = np.minimum(np.arange(len(time)) + 3, len(time) - 1)
    elapsed_s = np.maximum(time[after] - time[before], 1e-3)[:, None]
    velocity = (center[after] - center[before]) / elapsed_s
    moved = np.linalg.norm(velocity, axis=1) + CAMERA_SHARE * np.linalg.norm(
        (camera[after] - camera[before]) / elapsed_s, axis=1
    )
    velocity[(elapsed_s[:, 0] > MAX_SPAN_S) | (elapsed_s[:, 0] < MIN_SPAN_S)] = 0
    return velocity, STILL_WEIGHT + (1 - STILL_WEIGHT) * np.minimum(moved / NEW_VIEW_M_S, 1.0)


def _heading_cost(candidates, angle):
    """Return the cost of each hypothesis given the heading ``angle``, radians."""
    turned = rigid.wrap(angle - rigid.yaw(candidates.world_from_agent)) / np.deg2rad(HEADING_SIGMA_DEG)
    return candidates.cost + np.minimum(turned**2, FLIP_COST)
