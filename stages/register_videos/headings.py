"""The animal's heading over time: Viterbi decoding over a grid of headings, and the hypothesis of each frame
on it.

In depth, front and back look almost alike, and every fit errs by some degrees; over time an animal turns
steadily and walks head first. The head is the template's, a guess from shape that a hen's tail spoils: where
a recording clearly shows the animal walking the other way, that is its head. Frames that show little, fit
badly or repeat earlier views count little.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry import rigid, viterbi

HEADINGS = 36
"""Headings of the grid: steps of 10 degrees."""
NOISE_DEG, MAX_COST = 20.0, 12.0
"""A hypothesis turned by the first from a heading costs one unit more; one frame costs at most the second."""
MOTION_WEIGHT, WALKING_M_S = 4.0, (0.25, 0.6)
"""Units for walking tail first, counting from the first speed, fully from the second, m/s: an animal that
turns on the spot shows other sides."""
REVERSED_SHARE = 0.6
"""The template's head is the tail if that saves this share of what walking tail first costs at most, and more
than a turn to the other side."""
TURN_DEG, TURN_S, FLIP_COST = 30.0, 0.1, 40.0
"""A turn by so many degrees in so many seconds costs one unit, up to the last."""
STILL_WEIGHT, NEW_VIEW_M_S, CAMERA_SHARE = 0.06, 0.4, 0.5
"""Weight of a frame in which neither animal nor phone moves, speed from which a frame shows something new,
m/s, and the part of the phone's speed in it."""
ENOUGH_SHARE, MISFIT = 0.2, 6.0
"""Frames that show less of the animal than this share count less in proportion; frames whose best hypothesis
costs so many units more than the median frame's count half."""
SHORTEST_S, LONGEST_S = 0.15, 1.2
"""Velocities are measured over times between these, seconds."""


@dataclass(frozen=True)
class RootHypotheses:
    """Hypotheses of one frame and their costs, in units; pictures are read again when needed."""

    frame: int
    world_from_agent: Float[np.ndarray, "hypothesis 4 4"]
    cost: Float[np.ndarray, "hypothesis"]
    min_misfit: float
    """Cost of the best placement, by shape and colour alone."""
    share: float
    """Visible area over the area in full view, 0..1."""
    middle_world: Float[np.ndarray, "3"]
    """Middle of the points that were seen."""
    eye_world: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class MotionCues:
    """Motion around each observation."""

    velocity: Float[np.ndarray, "observation 3"]
    """Horizontal velocity of the seen points' middle, m/s; zero across gaps."""
    novelty: Float[np.ndarray, "observation"]
    """0..1: how much a frame shows that its neighbours did not; repeated views err together."""


def choose(timestamp_s: Float[np.ndarray, "frame"], candidates: list[RootHypotheses]) -> list[int]:
    """Choose one hypothesis per frame: the one of least cost, its turn from the decoded heading included."""
    decoded = path(timestamp_s, candidates)
    return [int(_turned_cost(each, angle).argmin()) for each, angle in zip(candidates, decoded, strict=True)]


def path(
    timestamp_s: Float[np.ndarray, "frame"], candidates: list[RootHypotheses]
) -> Float[np.ndarray, "observation"]:
    """Return the likeliest heading of each observation, radians, by Viterbi decoding over a grid of headings.

    It is decoded for an animal that walks along +z of its template, and for one that walks along -z.
    """
    grid = 2 * np.pi * np.arange(HEADINGS) / HEADINGS - np.pi
    moves, weight = motion_cues(timestamp_s, candidates), weights(candidates)
    walking = MOTION_WEIGHT * weight * _walking(moves)
    look = [_own_cost(each, grid, moves.novelty[index]) for index, each in enumerate(candidates)]
    turn = (rigid.wrap(grid[:, None] - grid[None]) / np.deg2rad(TURN_DEG)) ** 2

    def turn_cost(index: int) -> Float[np.ndarray, "before after"]:
        elapsed = timestamp_s[candidates[index].frame] - timestamp_s[candidates[index - 1].frame]
        tenths = max(elapsed / TURN_S, 1.0)
        return np.minimum(turn / tenths, FLIP_COST / np.sqrt(tenths))

    def decoded(sense: float) -> tuple[Float[np.ndarray, "observation"], float]:
        against = 1 - sense * np.cos(grid - np.arctan2(*moves.velocity[:, [0, 2]].T)[:, None])
        unary = weight[:, None] * look + walking[:, None] * against / 2
        state = viterbi.viterbi_decode(unary, turn_cost)
        turns = sum(turn_cost(index)[state[index - 1], state[index]] for index in range(1, len(state)))
        return grid[state], float(unary[np.arange(len(state)), state].sum() + turns)

    (head_first, cost), (tail_first, reversed_cost) = decoded(1.0), decoded(-1.0)
    clearly = max(FLIP_COST, REVERSED_SHARE * walking.sum())
    return tail_first if cost - reversed_cost > clearly else head_first


def weights(candidates: list[RootHypotheses]) -> Float[np.ndarray, "observation"]:
    """Return the weight of each frame, 0..1: less where little is seen and where nothing fits."""
    misfit, share = (
        np.array([getattr(each, name) for each in candidates]) for name in ("min_misfit", "share")
    )
    worse = np.maximum(misfit - np.median(misfit), 0) / MISFIT
    return np.minimum(share / ENOUGH_SHARE, 1.0) / (1 + worse**2)


def motion_cues(
    timestamp_s: Float[np.ndarray, "frame"], candidates: list[RootHypotheses], span: int = 3
) -> MotionCues:
    """Measure motion over ``span`` observations before and after each."""
    middle = np.stack([each.middle_world for each in candidates]) * (1, 0, 1)
    phone = np.stack([each.eye_world for each in candidates])
    time = timestamp_s[[each.frame for each in candidates]]
    before = np.maximum(np.arange(len(time)) - span, 0)
    after = np.minimum(np.arange(len(time)) + span, len(time) - 1)
    elapsed = np.maximum(time[after] - time[before], 1e-3)[:, None]
    velocity = (middle[after] - middle[before]) / elapsed
    moved = np.linalg.norm(velocity, axis=1) + CAMERA_SHARE * np.linalg.norm(
        (phone[after] - phone[before]) / elapsed, axis=1
    )
    velocity[(elapsed[:, 0] > LONGEST_S) | (elapsed[:, 0] < SHORTEST_S)] = 0
    return MotionCues(velocity, STILL_WEIGHT + (1 - STILL_WEIGHT) * np.minimum(moved / NEW_VIEW_M_S, 1.0))


def _turned_cost(candidates, angle):
    """Return the cost of each hypothesis if the animal faces ``angle``."""
    turned = rigid.wrap(angle - rigid.yaw(candidates.world_from_agent)) / np.deg2rad(NOISE_DEG)
    return candidates.cost + np.minimum(turned**2, FLIP_COST)


def _walking(moves: MotionCues) -> Float[np.ndarray, "observation"]:
    """Return 0..1: how surely the animal walks."""
    slow, fast = WALKING_M_S
    return np.clip((np.hypot(*moves.velocity[:, [0, 2]].T) - slow) / (fast - slow), 0, 1)


def _own_cost(candidates, grid, novelty):
    """Return one frame's cost of each heading of the grid, by looks alone."""
    seen = _turned_cost(candidates, grid[:, None]).min(1)
    return novelty * np.minimum(seen - seen.min(), MAX_COST)
