"""Track the one animal-sized mover of a recording through its candidates, frame by frame.

`candidates` groups points that other frames saw through; `track` chooses at most one group a frame by dynamic
programming over size, evidence and speed, looking at the whole recording at once.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float, Int

from pipeline.geometry import viterbi
from stages.segment_agent.config import AnimalConfig
from stages.segment_agent.free_space import Votes

HINT_REWARD, HINT_SLACK_M = 1000.0, 0.2
"""outweighs everything else; how far beside a candidate a hint may lie"""
SURE_SHARES = (1.0, 0.3)
"""references that must have seen through a point to learn from it, as a share of those that saw a surface
there; the second where nothing goes anywhere by the first"""
TRAVEL_M = 0.2
"""way that something must go by itself to be an animal beyond doubt: what people moved stays where it is"""
FREE_M = 0.1
"""how far a candidate's centre may jump without motion: another part of the animal is seen"""
EXCESS_M = 0.3
"""way beyond the fastest that costs as much as a convincing candidate is worth"""
MIN_VOTES, MIN_SHARE = 2, 0.05
"""references that must have seen through a point, and more as a share of those that saw a surface there"""
MIN_AREA_M2, MIN_PIXELS = 0.003, 6
"""smallest visible area of a candidate, the head of a cat; samples that chance does not bring together"""
LIKELY_AREA_M2 = 0.03
"""visible area from which on a candidate is fully convincing: a third of a cat from the side"""
CANDIDATES = 6
"""groups kept per frame"""
PRESUMED_S = 3.0
"""how long the animal is looked for around where it was last or will next be seen"""
ABSENT_S = 0.5
"""absence after which a track is not trusted to go on with what a hint points at"""
MOTION, CLEAR_MOTION = 2.0, 3.0
"""log-odds by which motion speaks for a point once the appearance is known; more where clearly more
references saw through it than saw a surface there"""
SETTLED = 1.0
"""log-odds by which a surface that other frames saw speaks against it then"""
APPEARANCE_LIMIT = 3.0
"""largest log-odds of the appearance there"""
APPEAR_COST = 2.0
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


def moving(votes: Votes) -> Bool[np.ndarray, "*shape"]:
    """Return which points lie in space that is free at other times."""
    return votes.free >= MIN_VOTES + MIN_SHARE * votes.occupied


def surely_moving(votes: Votes, share: float) -> Bool[np.ndarray, "*shape"]:
    """Return which points lie in space that is free at a good share of other times: enough to learn from."""
    return (votes.free > MIN_VOTES) & (votes.free >= share * votes.occupied)


def clearly_moving(votes: Votes) -> Bool[np.ndarray, "*shape"]:
    """Return which points clearly more references saw through than saw a surface there."""
    return votes.free - votes.occupied > MIN_VOTES


def motion(votes: Votes) -> Float[np.ndarray, "*shape"]:
    """Return the log-odds by which points that move speak for an animal of known appearance; else 0."""
    return np.where(moving(votes), np.where(clearly_moving(votes), CLEAR_MOTION, MOTION), 0.0)


def groups(is_moving: Bool[np.ndarray, "height width"]) -> Iterator[Bool[np.ndarray, "height width"]]:
    """Return the groups of moving pixels that nearly touch, larger than what chance brings together."""
    closed = cv2.dilate(is_moving.astype(np.uint8), np.ones((3, 3), np.uint8))
    count, label = cv2.connectedComponents(closed, connectivity=8)
    for index in range(1, count):
        own = (label == index) & is_moving
        if own.sum() >= MIN_PIXELS:
            yield own


def candidates(
    is_moving: Bool[np.ndarray, "height width"],
    probability: Float[np.ndarray, "height width"],
    points_world: Float[np.ndarray, "height width 3"],
    area_m2: Float[np.ndarray, "height width"],
    animal: AnimalConfig,
) -> list[Candidate]:
    """Group moving pixels that touch, largest area first; ``area_m2`` is what each covers at its distance."""
    found = []
    for own in groups(is_moving):
        area = float(area_m2[own].sum())
        if area < MIN_AREA_M2:
            continue
        points = points_world[own]
        centre = np.median(points, axis=0)
        radius = float(np.quantile(np.linalg.norm(points - centre, axis=1), 0.95))
        if radius < animal.largest_m:
            found.append(Candidate(centre, area, radius, float(probability[own].mean())))
    return sorted(found, key=lambda candidate: -candidate.area_m2)[:CANDIDATES]


def track(
    found: Sequence[Sequence[Candidate]],
    timestamp_s: Float[np.ndarray, "frame"],
    animal: AnimalConfig,
    hint: Hint | None = None,
) -> Int[np.ndarray, "frame"]:
    """Choose one candidate per frame (-1: none in view) by the Viterbi algorithm over scores and speeds.

    A hint outweighs everything else in its frame.
    """
    scores = [np.array([0.0] + [_score(candidate, animal) for candidate in group]) for group in found]
    if hint is not None and hint.frame in range(len(found)):
        scores[hint.frame][1:] += [HINT_REWARD * _meant(candidate, hint) for candidate in found[hint.frame]]
    scores[0][1:] -= APPEAR_COST

    def change(index: int) -> Float[np.ndarray, "before after"]:
        seconds = timestamp_s[index] - timestamp_s[index - 1]
        return -_transition(found[index - 1], found[index], seconds, animal)

    return viterbi.viterbi_decode([-score for score in scores], change) - 1


def connected(
    chosen: Sequence[Candidate | None],
    timestamp_s: Float[np.ndarray, "frame"],
    animal: AnimalConfig,
    hint: Hint,
) -> Bool[np.ndarray, "frame"]:
    """Return in which frames a track surely has what a hint points at: nowhere on the way there it is absent
    or faster than an animal. Nowhere if it is elsewhere at the time of the hint."""
    seen = np.array([frame for frame, candidate in enumerate(chosen) if candidate is not None], int)
    surely = np.zeros(len(chosen), bool)
    wait_s = np.abs(timestamp_s[seen] - timestamp_s[hint.frame])
    nearest = chosen[int(seen[wait_s.argmin()])] if len(seen) else None
    if nearest is None or wait_s.min() > ABSENT_S or not _meant(nearest, hint):
        return surely
    piece = pieces(chosen, seen, timestamp_s, animal)
    surely[seen[piece == piece[wait_s.argmin()]]] = True
    return surely


def pieces(
    chosen: Sequence[Candidate | None],
    seen: Int[np.ndarray, "seen"],
    timestamp_s: Float[np.ndarray, "frame"],
    animal: AnimalConfig,
) -> Int[np.ndarray, "seen"]:
    """Number the pieces of a track between absences and jumps."""
    gap_s = np.diff(timestamp_s[seen])
    apart_m = np.linalg.norm(np.diff([chosen[frame].centre_world for frame in seen], axis=0), axis=1)
    jump = (gap_s > ABSENT_S) | (apart_m > FREE_M + animal.speed_m_s * gap_s)
    return np.cumsum(np.r_[False, jump])


def self_moving(
    chosen: Sequence[Candidate | None], timestamp_s: Float[np.ndarray, "frame"], animal: AnimalConfig
) -> Bool[np.ndarray, "frame"]:
    """Return in which frames a track surely has an animal: in pieces that last and go somewhere.

    Things that people put elsewhere, and rims that misalignment makes seem to move, stay in place or flash.
    """
    seen = np.array([frame for frame, candidate in enumerate(chosen) if candidate is not None], int)
    surely = np.zeros(len(chosen), bool)
    if not len(seen):
        return surely
    piece = pieces(chosen, seen, timestamp_s, animal)
    for number in range(piece[-1] + 1):
        own = seen[piece == number]
        if timestamp_s[own[-1]] - timestamp_s[own[0]] < ABSENT_S:
            continue
        centre = np.array([chosen[frame].centre_world for frame in own])
        centre = scipy.ndimage.median_filter(centre, (5, 1), mode="nearest")
        if np.linalg.norm(np.ptp(centre, axis=0)) > TRAVEL_M:
            surely[own] = True
    return surely


def _meant(candidate: Candidate, hint: Hint) -> bool:
    """Return whether a hint may point at a candidate."""
    return bool(
        np.linalg.norm(candidate.centre_world - hint.centre_world) < candidate.radius_m + HINT_SLACK_M
    )


def _score(candidate: Candidate, animal: AnimalConfig) -> float:
    """Reward area up to a convincing one; half if larger than an animal, none if doubtful."""
    reward = max(2 * candidate.conviction - 1, 0) * min(candidate.area_m2 / LIKELY_AREA_M2, 1.0) ** 0.5
    return reward * (0.5 if candidate.radius_m > animal.largest_m / 2 else 1.0)


def _transition(
    before: Sequence[Candidate], after: Sequence[Candidate], seconds: float, animal: AnimalConfig
) -> Float[np.ndarray, "from to"]:
    """Reward of going from each state to each; state 0 is absence."""
    step = np.full((len(before) + 1, len(after) + 1), -APPEAR_COST)
    step[0, 0] = 0.0
    if before and after:
        first, second = (np.stack([each.centre_world for each in group]) for group in (before, after))
        apart = np.linalg.norm(first[:, None] - second[None], axis=-1)
        excess = np.maximum(apart - FREE_M - animal.speed_m_s * seconds, 0) / EXCESS_M
        step[1:, 1:] = -np.minimum(excess, 2 * APPEAR_COST)
    return step
