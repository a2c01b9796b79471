"""The likeliest way of the agent through places, unseen: it walks and rests as it is seen to, and not where the phone looked."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist

from stages.reconstruct.places import CELL_M, Places

STILL, MOVING = 0, 1
WINDOW_S = 0.3
"""speeds are told over this long"""
MOVING_M_S = 0.2
"""faster than this is moving"""
WAY = 0.15
"""nats per cell of way: short ways are likelier"""
DAWDLING = 5.0
"""nats per second that it neither moves on nor rests"""
HAUNT_M = 0.2
"""where the agent was seen resting, it rests again within about this"""
ELSEWHERE = 0.01
"""share of its rests that are anywhere else"""


@dataclass(frozen=True)
class Habits:
    """How the agent goes about, learned where it is seen."""

    fast_m_s: float
    """hardly ever faster"""
    stops_per_s: float
    starts_per_s: float
    haunts: Float[np.ndarray, "rest 3"]
    """where its root was seen at rest, one place for each while of rest"""

    @classmethod
    def of(cls, timestamp_s: list, root: list, seen: list) -> "Habits":
        """Learn from the roots ``[frame 3]`` of several videos, where they were seen."""
        speeds, modes, stops, starts, haunts = [], [], 0, 0, []
        for when, place, good in zip(timestamp_s, root, seen, strict=True):
            speed, told = speeds_of(when, place, good)
            moving = speed > MOVING_M_S
            next_to = told[1:] & told[:-1]
            starts += int((next_to & moving[1:] & ~moving[:-1]).sum())
            stops += int((next_to & ~moving[1:] & moving[:-1]).sum())
            step = np.gradient(when)
            speeds.append(speed[told & moving])
            modes.append([(step * (told & moving)).sum(), (step * (told & ~moving)).sum()])
            haunts.append(_rests(place, told & ~moving))
        speed, (moving_s, still_s) = np.concatenate(speeds), np.sum(modes, axis=0)
        fast = np.quantile(speed, 0.95) if len(speed) > 10 else 1.5
        return cls(float(fast), (stops + 1) / (moving_s + 2), (starts + 1) / (still_s + 5), np.concatenate(haunts))

    def attraction(self, place: Float[np.ndarray, "cell 3"], most: int = 2000) -> Float[np.ndarray, "cell"]:
        """Return the logarithm of how much likelier rest is in each cell than if all of 10 square metres were alike."""
        some = self.haunts[:: max(1, len(self.haunts) // most)]
        if not len(some):
            return np.zeros(len(place))
        squared = cdist(place, some, "sqeuclidean") / HAUNT_M**2
        kernel = np.exp(-0.5 * squared).mean(1) * 10 / (2 * np.pi * HAUNT_M**2)
        return np.log(ELSEWHERE + (1 - ELSEWHERE) * kernel)


def _rests(root: Float[np.ndarray, "frame 3"], still: Bool[np.ndarray, "frame"]) -> Float[np.ndarray, "rest 3"]:
    """Return the middle of each while of rest."""
    return np.array([np.median(root[each], axis=0) for each in runs(still) if len(each) > 4]).reshape(-1, 3)


def runs(chosen: Bool[np.ndarray, "frame"]) -> list[Int[np.ndarray, "run"]]:
    """Return the frames of each unbroken run of chosen ones."""
    frames = np.flatnonzero(chosen)
    return np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1) if len(frames) else []


def speeds_of(
    timestamp_s: Float[np.ndarray, "frame"], root: Float[np.ndarray, "frame 3"], seen: Bool[np.ndarray, "frame"]
) -> tuple[Float[np.ndarray, "frame"], Bool[np.ndarray, "frame"]]:
    """Return speeds over `WINDOW_S` around each frame, and where they can be told: the agent is seen all the while."""
    before = np.searchsorted(timestamp_s, timestamp_s - WINDOW_S / 2 - 1e-6)
    after = np.minimum(np.searchsorted(timestamp_s, timestamp_s + WINDOW_S / 2 + 1e-6), len(timestamp_s) - 1)
    missing = np.concatenate([[0], np.cumsum(~seen)])
    told = (missing[after + 1] == missing[before]) & (after > before)
    span = np.maximum(timestamp_s[after] - timestamp_s[before], 1e-6)
    return np.where(told, np.linalg.norm(root[after] - root[before], axis=1) / span, 0), told


@dataclass(frozen=True)
class End:
    """What is known where a hidden stretch begins or ends."""

    cell: int
    moving: bool


def likeliest(
    places: Places,
    habits: Habits,
    evidence: Float[np.ndarray, "frame cell"],
    duration_s: Float[np.ndarray, "interval"],
    first: End | None,
    last: End | None,
) -> tuple[Int[np.ndarray, "frame"], Bool[np.ndarray, "frame"]]:
    """Return in which cell the agent was at each frame, and whether it moved: Viterbi over places and modes.

    Frames include those of both ends, whose evidence is not read where they are known; between them lie ``duration_s``.
    """
    cells = len(places.position)
    rest = habits.attraction(places.position)
    score = _begin(cells, rest, first)
    if first is None:
        score += evidence[0]
    trace = []
    for row, duration in enumerate(duration_s, start=1):
        steps = max(1, int(np.ceil(duration * habits.fast_m_s / CELL_M)))
        back = []
        for _ in range(steps):
            score, came = _step(score, places, habits, rest, duration / steps)
            back.append(came)
        trace.append(back)
        if row < len(duration_s) or last is None:
            score = score + evidence[row]
    state = int(score.argmax()) if last is None else _state(last, cells)
    if not np.isfinite(score.flat[state]):
        state = int(score.argmax())
    found = [state]
    for back in reversed(trace):
        for came in reversed(back):
            state = int(came.flat[state])
        found.append(state)
    states = np.array(found[::-1])
    return states % cells, states // cells == MOVING


def _state(end: End, cells: int) -> int:
    return end.cell + cells * int(end.moving)


def _begin(cells: int, rest: Float[np.ndarray, "cell"], first: End | None) -> Float[np.ndarray, "mode cell"]:
    if first is None:
        return np.stack([rest, np.full(cells, -2.0)])
    score = np.full((2, cells), -np.inf)
    score.flat[_state(first, cells)] = 0
    return score


def _step(
    score: Float[np.ndarray, "mode cell"], places: Places, habits: Habits, rest: Float[np.ndarray, "cell"], duration_s: float
) -> tuple[Float[np.ndarray, "mode cell"], Int[np.ndarray, "mode cell"]]:
    """Go on by one step: stay, start, stop or move to a neighbour. Returns scores, and the state that each came from."""
    cells = score.shape[1]
    here = np.arange(cells)
    stop, start = (1 - np.exp(-rate * duration_s) for rate in (habits.stops_per_s, habits.starts_per_s))
    kept, stopped = score[STILL] + np.log1p(-start), score[MOVING] + np.log(stop) + rest
    still = np.maximum(kept, stopped)
    still_from = np.where(kept >= stopped, here, here + cells)
    moved = score[MOVING][places.origin] + np.log1p(-stop) - WAY * places.effort
    best, best_from = _best_per_target(moved, places, cells)
    slow, started = score[MOVING] + np.log1p(-stop) - DAWDLING * duration_s, score[STILL] + np.log(start)
    moving = np.maximum(np.maximum(slow, started), best)
    moving_from = np.where(best >= np.maximum(slow, started), best_from + cells, np.where(slow >= started, here + cells, here))
    return np.stack([still, moving]), np.stack([still_from, moving_from]).astype(np.int32)


def _best_per_target(
    moved: Float[np.ndarray, "step"], places: Places, cells: int
) -> tuple[Float[np.ndarray, "cell"], Int[np.ndarray, "cell"]]:
    """Return the best of the steps that lead to each cell, and where it comes from."""
    best, source = np.full(cells, -np.inf), np.zeros(cells, int)
    if not len(moved):
        return best, source
    begin = np.flatnonzero(np.r_[True, places.target[1:] != places.target[:-1]])
    best[places.target[begin]] = np.maximum.reduceat(moved, begin)
    hit = moved == best[places.target]
    source[places.target[hit]] = places.origin[hit]
    return best, source
