"""Track the one animal-sized mover of a recording through its candidates, frame by frame.

`candidates` groups points that other frames saw through; `track` chooses at most one group a frame by dynamic
programming over size, evidence and speed, looking at the whole recording at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline import viterbi
from stages.segment_agent.free_space import Votes

HINT_REWARD = 1000.0
FREE_M = 0.1
"""how far a candidate's centre may jump without motion: another part of the animal is seen"""


@dataclass(frozen=True)
class Mover:
    """What an animal may be like and how it may move."""

    least_votes: int = 2
    """references that must have seen through a point"""
    least_share: float = 0.05
    """the same as a share of the references that saw a surface there, added"""
    least_area_m2: float = 0.003
    """smallest visible area of a candidate"""
    likely_area_m2: float = 0.03
    """visible area from which on a candidate is fully convincing"""
    largest_m: float = 1.3
    """largest extent of an animal; groups that are larger, up to twice that, count half"""
    speed_m_s: float = 2.5
    """fastest motion that costs nothing much"""
    candidates: int = 6
    """groups kept per frame"""
    presumed_s: float = 3.0
    """how long the animal is looked for around where it was last or will next be seen"""
    absent_s: float = 0.5
    """absence after which a track is not trusted to go on with what a hint points at"""
    motion: float = 2.0
    """log-odds by which motion speaks for a point once the looks are known"""
    clear_motion: float = 3.0
    """the same where clearly more references saw through the point than saw a surface there"""
    settled: float = 1.0
    """log-odds by which a surface that other frames saw speaks against it then"""
    looks_limit: float = 3.0
    """largest log-odds of the looks there"""
    appear_cost: float = 1.0
    """cost of leaving or entering the view, in units of a convincing candidate"""


@dataclass(frozen=True)
class Candidate:
    """A connected group of points seen through by other frames."""

    centre_world: Float[np.ndarray, "3"]
    area_m2: float
    radius_m: float
    """distance from the centre that holds 95 % of the points"""
    conviction: float = 1.0
    """mean probability of its points"""


@dataclass(frozen=True)
class Hint:
    """Where a user says the animal is."""

    frame: int
    centre_world: Float[np.ndarray, "3"]
    reach_m: float = 0.5
    """how far from there the animal reaches; a click leaves it open"""


def moving(votes: Votes, options: Mover) -> Bool[np.ndarray, "*shape"]:
    """Tell which points lie in space that is free at other times."""
    return votes.free >= options.least_votes + options.least_share * votes.occupied


def clearly_moving(votes: Votes, options: Mover) -> Bool[np.ndarray, "*shape"]:
    """Tell which points clearly more references saw through than saw a surface there."""
    return votes.free - votes.occupied > options.least_votes


def motion(votes: Votes, options: Mover) -> Float[np.ndarray, "*shape"]:
    """Return the log-odds by which points that move speak for an animal whose looks are known; 0 for the others."""
    return np.where(moving(votes, options), np.where(clearly_moving(votes, options), options.clear_motion, options.motion), 0.0)


def candidates(
    is_moving: Bool[np.ndarray, "height width"],
    probability: Float[np.ndarray, "height width"],
    points_world: Float[np.ndarray, "height width 3"],
    area_m2: Float[np.ndarray, "height width"],
    options: Mover,
) -> list[Candidate]:
    """Group moving pixels that touch, largest area first; ``area_m2`` is what each pixel covers at its distance."""
    closed = cv2.dilate(is_moving.astype(np.uint8), np.ones((3, 3), np.uint8))
    count, label = cv2.connectedComponents(closed, connectivity=8)
    found = []
    for index in range(1, count):
        own = (label == index) & is_moving
        area = float(area_m2[own].sum())
        if area < options.least_area_m2 or own.sum() < 6:
            continue
        points = points_world[own]
        centre = np.median(points, axis=0)
        radius = float(np.quantile(np.linalg.norm(points - centre, axis=1), 0.95))
        if radius < options.largest_m:
            found.append(Candidate(centre, area, radius, float(probability[own].mean())))
    return sorted(found, key=lambda candidate: -candidate.area_m2)[: options.candidates]


def track(
    found: Sequence[Sequence[Candidate]], timestamp_s: Float[np.ndarray, "frame"], options: Mover, hint: Hint | None = None
) -> Int[np.ndarray, "frame"]:
    """Choose one candidate per frame (-1: none in view) by the Viterbi algorithm over scores and speeds.

    A hint outweighs everything else in its frame.
    """
    scores = [np.array([0.0] + [_score(candidate, options) for candidate in group]) for group in found]
    if hint is not None and hint.frame in range(len(found)):
        scores[hint.frame][1:] += [HINT_REWARD * _meant(candidate, hint) for candidate in found[hint.frame]]
    scores[0][1:] -= options.appear_cost

    def change(index: int) -> Float[np.ndarray, "before after"]:
        return -_transition(found[index - 1], found[index], timestamp_s[index] - timestamp_s[index - 1], options)

    return viterbi.cheapest([-score for score in scores], change) - 1


def connected(
    chosen: Sequence[Candidate | None], timestamp_s: Float[np.ndarray, "frame"], options: Mover, hint: Hint
) -> Bool[np.ndarray, "frame"]:
    """Tell in which frames a track surely has what a hint points at: nowhere on the way there it is absent or faster than
    an animal. Nowhere if it is elsewhere at the time of the hint.
    """
    seen = np.array([frame for frame, candidate in enumerate(chosen) if candidate is not None], int)
    surely = np.zeros(len(chosen), bool)
    wait_s = np.abs(timestamp_s[seen] - timestamp_s[hint.frame])
    if not len(seen) or wait_s.min() > options.absent_s or not _meant(chosen[seen[wait_s.argmin()]], hint):
        return surely
    gap_s = np.diff(timestamp_s[seen])
    apart_m = np.linalg.norm(np.diff([chosen[frame].centre_world for frame in seen], axis=0), axis=1)
    piece = np.cumsum(np.r_[False, (gap_s > options.absent_s) | (apart_m > FREE_M + options.speed_m_s * gap_s)])
    surely[seen[piece == piece[wait_s.argmin()]]] = True
    return surely


def _meant(candidate: Candidate, hint: Hint) -> bool:
    """Tell whether a hint may point at a candidate."""
    return bool(np.linalg.norm(candidate.centre_world - hint.centre_world) < candidate.radius_m + 0.2)


def _score(candidate: Candidate, options: Mover) -> float:
    """Reward area up to a convincing one; halve what is larger than an animal, and count nothing that is as likely as not."""
    reward = max(2 * candidate.conviction - 1, 0) * min(candidate.area_m2 / options.likely_area_m2, 1.0) ** 0.5
    return reward * (0.5 if candidate.radius_m > options.largest_m / 2 else 1.0)


def _transition(before: Sequence[Candidate], after: Sequence[Candidate], seconds: float, options: Mover) -> Float[np.ndarray, "from to"]:
    """Reward of going from each state to each; state 0 is absence."""
    step = np.full((len(before) + 1, len(after) + 1), -options.appear_cost)
    step[0, 0] = 0.0
    if before and after:
        apart = np.linalg.norm(
            np.stack([c.centre_world for c in before])[:, None] - np.stack([c.centre_world for c in after])[None], axis=-1
        )
        excess = np.maximum(apart - FREE_M - options.speed_m_s * seconds, 0) / 0.3
        step[1:, 1:] = -np.minimum(excess, 2.5 * options.appear_cost)
    return step
