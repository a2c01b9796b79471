"""Track the one animal-sized moving object of a recording.

`candidates` groups points that other frames saw through; `track` chooses at most one group per frame by the
Viterbi algorithm over size, evidence and speed, globally over the recording.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float, Int

from pipeline.geometry import viterbi
from stages.segment_agent.config import AnimalConfig
from stages.segment_agent.free_space import Votes

PROMPT_REWARD, PROMPT_SLACK_M = 1000.0, 0.2
"""score of a candidate at the prompt, above all else; tolerated distance of the prompt from it"""
SURE_SHARES = (1.0, 0.3)
"""references that must have seen through a point for training, as a share of those that saw a surface there;
the second is used if nothing travels by the first"""
TRAVEL_M = 0.2
"""distance that a mover must travel to be certainly an animal: things moved by people stay in place"""
JUMP_M = 0.1
"""free jump of a candidate's center: another part of the animal may be seen"""
EXCESS_M = 0.3
"""excess distance whose cost equals the score of a full candidate"""
MIN_VOTES, MIN_SHARE = 2, 0.05
"""votes for a moving point: references that saw through it, plus a share of those that saw a surface there"""
MIN_AREA_M2, MIN_PIXELS = 0.003, 6
"""smallest visible area of a candidate, the head of a cat; fewest samples of a group"""
FULL_SCORE_AREA_M2 = 0.03
"""visible area of a candidate with full score: a third of a cat from the side"""
CANDIDATES = 6
"""groups kept per frame"""
PRESUMED_S = 3.0
"""time for which the animal is presumed near its last or next known place"""
MIN_MOVING = 0.1
"""mean share of moving points of a segment below which it may be furniture that looks like the animal"""
ABSENT_S = 0.5
"""absence that splits a track"""
MOTION, CLEAR_MOTION = 2.0, 3.0
"""log-odds of a moving point once the appearance is known; the second where clearly more references saw
through it than saw a surface there"""
STATIC_PENALTY = 1.0
"""log-odds against a static surface once the appearance is known"""
APPEARANCE_LIMIT = 3.0
"""limit on the appearance's log-odds beside motion"""
APPEAR_COST = 2.0
"""cost of leaving or entering the view, in full candidate scores"""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A connected group of points seen through by other frames."""

    center_world: Float[np.ndarray, "3"]
    area_m2: float
    radius_m: float
    """95th percentile of the points' distances from the center"""
    probability: float = 1.0
    """mean probability of its points"""
    moving: float = 1.0
    """share of its points in space that is free at other times"""


AnyCandidate = TypeVar("AnyCandidate", bound=Candidate)


@dataclass(frozen=True)
class PlacedPrompt:
    """A prompt lifted to the world."""

    frame: int
    center_world: Float[np.ndarray, "3"]
    reach_m: float = 0.5
    """extent of the animal around that point; the default for a click"""


def moving(votes: Votes) -> Bool[np.ndarray, "*shape"]:
    """Return which points lie in space that is free at other times."""
    return votes.free >= MIN_VOTES + MIN_SHARE * votes.occupied


def clearly_moving(votes: Votes) -> Bool[np.ndarray, "*shape"]:
    """Return points that clearly more references saw through than saw a surface at."""
    return votes.free - votes.occupied > MIN_VOTES


def motion_log_odds(votes: Votes) -> Float[np.ndarray, "*shape"]:
    """Return the log-odds of moving points, for an animal of known appearance; 0 elsewhere."""
    return np.where(moving(votes), np.where(clearly_moving(votes), CLEAR_MOTION, MOTION), 0.0)


def components(is_moving: Bool[np.ndarray, "height width"]) -> Iterator[Bool[np.ndarray, "height width"]]:
    """Yield the connected components of the dilated moving pixels, without tiny ones."""
    closed = cv2.dilate(is_moving.astype(np.uint8), np.ones((3, 3), np.uint8))
    count, label = cv2.connectedComponents(closed, connectivity=8)
    for index in range(1, count):
        own = (label == index) & is_moving
        if own.sum() >= MIN_PIXELS:
            yield own


def candidates(
    chosen: Bool[np.ndarray, "height width"],
    probability: Float[np.ndarray, "height width"],
    points_world: Float[np.ndarray, "height width 3"],
    area_m2: Float[np.ndarray, "height width"],
    animal: AnimalConfig,
    seen_through: Callable[[Float[np.ndarray, "point 3"]], bool],
    moving: Bool[np.ndarray, "height width"] | None = None,
) -> list[Candidate]:
    """Group pixels, largest area first; ``area_m2`` is the area of each pixel at its distance.

    ``moving`` marks those that seem to move, all by default. A group that is not ``seen_through`` does not.
    """
    found = []
    for own in components(chosen):
        area = float(area_m2[own].sum())
        if area < MIN_AREA_M2:
            continue
        points = points_world[own]
        center = np.median(points, axis=0)
        radius = float(np.quantile(np.linalg.norm(points - center, axis=1), 0.95))
        if radius < animal.largest_m:
            through = own if moving is None else own & moving
            share = float(through[own].mean()) * seen_through(points_world[through])
            if moving is not None or share:
                found.append(Candidate(center, area, radius, float(probability[own].mean()), share))
    return sorted(found, key=lambda candidate: -candidate.area_m2)[:CANDIDATES]


def track(
    found: Sequence[Sequence[AnyCandidate]],
    timestamp_s: Float[np.ndarray, "frame"],
    animal: AnimalConfig,
    prompt: PlacedPrompt | None = None,
) -> list[AnyCandidate | None]:
    """Choose one candidate per frame (None: out of view) by the Viterbi algorithm over scores and speeds.

    In its frame, a prompt outweighs everything else.
    """
    scores = [np.array([0.0] + [_score(candidate, animal) for candidate in group]) for group in found]
    if prompt is not None and prompt.frame in range(len(found)):
        scores[prompt.frame][1:] += [
            PROMPT_REWARD * _at_prompt(candidate, prompt) for candidate in found[prompt.frame]
        ]
    scores[0][1:] -= APPEAR_COST

    def change(index: int) -> Float[np.ndarray, "before after"]:
        seconds = timestamp_s[index] - timestamp_s[index - 1]
        return -_transition(found[index - 1], found[index], seconds, animal)

    states = viterbi.viterbi_decode([-score for score in scores], change)
    return [group[state - 1] if state else None for group, state in zip(found, states, strict=True)]


def connected_to_prompt(
    chosen: Sequence[Candidate | None],
    timestamp_s: Float[np.ndarray, "frame"],
    animal: AnimalConfig,
    prompt: PlacedPrompt,
) -> Bool[np.ndarray, "frame"]:
    """Return the frames of the track segment that contains the prompt; none if the track misses it."""
    reliable = np.zeros(len(chosen), bool)
    wait_s = np.abs(timestamp_s - timestamp_s[prompt.frame])
    own = min(segments(chosen, timestamp_s, animal), key=lambda frames: wait_s[frames].min(), default=None)
    if own is not None and wait_s[own].min() <= ABSENT_S:
        nearest = chosen[int(own[wait_s[own].argmin()])]
        reliable[own] = nearest is not None and _at_prompt(nearest, prompt)
    return reliable


def segments(
    chosen: Sequence[Candidate | None], timestamp_s: Float[np.ndarray, "frame"], animal: AnimalConfig
) -> list[Int[np.ndarray, "seen"]]:
    """Return the frames of each segment of a track between absences and jumps."""
    seen = np.array([frame for frame, candidate in enumerate(chosen) if candidate is not None], int)
    if not len(seen):
        return []
    gap_s = np.diff(timestamp_s[seen])
    apart_m = np.linalg.norm(np.diff([chosen[frame].center_world for frame in seen], axis=0), axis=1)
    jump = (gap_s > ABSENT_S) | (apart_m > JUMP_M + animal.speed_m_s * gap_s)
    return np.split(seen, np.flatnonzero(jump) + 1)


def self_moving(
    chosen: Sequence[Candidate | None], timestamp_s: Float[np.ndarray, "frame"], animal: AnimalConfig
) -> Bool[np.ndarray, "frame"]:
    """Return the frames of track segments that last and travel, which certainly show an animal.

    Things moved by people stay in place; edges that seem to move by misalignment are brief.
    """
    reliable = np.zeros(len(chosen), bool)
    for own in segments(chosen, timestamp_s, animal):
        if timestamp_s[own[-1]] - timestamp_s[own[0]] < ABSENT_S:
            continue
        center = np.array([chosen[frame].center_world for frame in own])
        center = scipy.ndimage.median_filter(center, (5, 1), mode="nearest")
        reliable[own] = np.linalg.norm(np.ptp(center, axis=0)) > TRAVEL_M
    return reliable


def plausible(
    chosen: Sequence[Candidate | None], timestamp_s: Float[np.ndarray, "frame"], animal: AnimalConfig
) -> Bool[np.ndarray, "frame"]:
    """Return the frames of segments that move or that the animal reaches between moving ones.

    The rest may be furniture that looks like it: where it rested, others saw through before or after.
    """
    reliable, parts = np.zeros(len(chosen), bool), segments(chosen, timestamp_s, animal)
    moves = [np.mean([chosen[frame].moving for frame in own]) > MIN_MOVING for own in parts]
    moving_parts = np.flatnonzero(moves)
    for index, own in enumerate(parts):
        before, after = moving_parts[moving_parts < index], moving_parts[moving_parts > index]
        steps = [(parts[each][-1], own[0]) for each in before[-1:]]
        steps += [(own[-1], parts[each][0]) for each in after[:1]]
        reliable[own] = moves[index] or all(
            np.linalg.norm(chosen[end].center_world - chosen[start].center_world)
            < JUMP_M + animal.speed_m_s * (timestamp_s[end] - timestamp_s[start])
            for start, end in steps
        )
    return reliable


def _at_prompt(candidate: Candidate, prompt: PlacedPrompt) -> bool:
    """Return whether a prompt lies at a candidate."""
    off_m = np.linalg.norm(candidate.center_world - prompt.center_world)
    return bool(off_m < candidate.radius_m + PROMPT_SLACK_M)


def _score(candidate: Candidate, animal: AnimalConfig) -> float:
    """Score a candidate by area and probability; half if larger than an animal."""
    reward = max(2 * candidate.probability - 1, 0) * min(candidate.area_m2 / FULL_SCORE_AREA_M2, 1.0) ** 0.5
    return reward * (0.5 if candidate.radius_m > animal.largest_m / 2 else 1.0)


def _transition(
    before: Sequence[Candidate], after: Sequence[Candidate], seconds: float, animal: AnimalConfig
) -> Float[np.ndarray, "from to"]:
    """Return transition scores between states; state 0 is absence."""
    step = np.full((len(before) + 1, len(after) + 1), -APPEAR_COST)
    step[0, 0] = 0.0
    if before and after:
        first, second = (np.stack([each.center_world for each in group]) for group in (before, after))
        distance_m = np.linalg.norm(first[:, None] - second[None], axis=-1)
        excess = np.maximum(distance_m - JUMP_M - animal.speed_m_s * seconds, 0) / EXCESS_M
        step[1:, 1:] = -np.minimum(excess, 2 * APPEAR_COST)
    return step
