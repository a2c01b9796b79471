"""What the points of a window say about showing the animal: geometry first, colour where it has changed.

`judge_motion` serves sessions; `turnaround` makes the judge of the other recordings.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields

import cv2
import numpy as np
from jaxtyping import Bool, Float

from stages.segment_agent import free_space, movers
from stages.segment_agent.free_space import References, Votes
from stages.segment_agent.windows import Sphere, Window


@dataclass(frozen=True)
class Evidence:
    """Log-odds that a window's points show the animal, how much to trust them, and which are beyond doubt."""

    log_odds: Float[np.ndarray, "height width"]
    certainty: Float[np.ndarray, "height width"]
    animal: Bool[np.ndarray, "height width"]
    clear: Bool[np.ndarray, "height width"]
    """animal by clear motion alone, at steps of depth too"""
    room: Bool[np.ndarray, "height width"]
    recolored: Float[np.ndarray, "height width"] | float = 0.0
    """part of `log_odds` by another colour alone: thin paws and tails, but gloss and shadows too"""


MOVING, ROOM = 3.0, 3.0
"""log-odds of a point in space that is free at other times, and on a surface that other frames saw"""
STEP_M, STEP_SPREAD_M = 0.022, 0.008
"""step in front of that surface that speaks neither way, and the step that is worth one more"""
RECOLORED = 1.0
"""log-odds for each time the noise by which such a surface's colour differs"""
DISTRUSTED, DISTRUSTED_BEHIND, DISTRUSTED_MOVING = 0.5, 0.25, 0.6
"""certainty of depth of low confidence or at a step (1 is that of all other depth): on such a surface, where
no animal is (the sensor may have looked past a tail), and in space that is free at other times"""
UNKNOWN = 0.05
"""certainty where nothing is known: what is around it decides"""
SURE_ROOM = 0.66
"""share of `ROOM` from which on a point is room beyond doubt"""
MIN_SETTLED_PX, MIN_NOISE = 50, 3.0
"""pixels without which colours are not compared, and their least noise, grey levels (JPEG)"""
FEW = 5.0
"""references that must have seen a surface to make it half certain: one or two may have seen the animal"""
ASKEW_PX = 2
"""how far a texture may lie from where it was, working pixels"""

Judge = Callable[[int, Window, Sphere], Evidence]


def judge_motion(references: References) -> Judge:
    """Evidence for sessions: free at other times is animal; on a surface that others saw is room.

    On such a surface a step towards the camera or another colour than the others saw there speaks for the
    animal: paws and tails are too thin for the depth sensor.
    """

    def judge(frame: int, window: Window, ball: Sphere) -> Evidence:
        known = np.isfinite(window.points_world[..., 0])
        near = np.linalg.norm(window.points_world - ball.centre_world, axis=-1) < ball.radius_m
        points = np.where(near[..., None], window.points_world, np.nan)
        votes = free_space.vote(references, points, frame, surfaces=True)
        animal = movers.moving(votes)
        settled = known & ~animal & (votes.occupied > 0)
        step = np.clip((votes.gap_m - STEP_M) / STEP_SPREAD_M, -ROOM, 1)
        color = np.where(settled, RECOLORED * recolored(window, votes, settled), 0.0)
        log_odds = np.where(animal, MOVING, np.where(settled, step + color, 0.0))
        elsewhere, seen = known & ~near, votes.occupied / (votes.occupied + FEW)
        doubted = np.where(animal, DISTRUSTED_MOVING, np.where(settled, DISTRUSTED, DISTRUSTED_BEHIND))
        certainty = np.where(settled, seen, 1.0) * np.where(window.trusted, 1.0, doubted)
        log_odds[elsewhere], color[elsewhere] = -ROOM, 0.0
        certainty[~(animal | settled | elsewhere)] = UNKNOWN
        clear = animal & movers.clearly_moving(votes)
        room = log_odds <= -SURE_ROOM * ROOM
        return Evidence(log_odds, certainty, animal & window.trusted, clear, room, color)

    return judge


def either(first: Judge, second: Judge) -> Judge:
    """Evidence by the first judge where that speaks for the animal, by the second elsewhere."""

    def judge(frame: int, window: Window, ball: Sphere) -> Evidence:
        preferred, other = first(frame, window, ball), second(frame, window, ball)
        own, names = preferred.log_odds > 0, [part.name for part in fields(Evidence)]
        return Evidence(*(np.where(own, getattr(preferred, name), getattr(other, name)) for name in names))

    return judge


def recolored(
    window: Window, votes: Votes, settled: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width"]:
    """Return by how many times the noise (0..6) a surface shows another colour than at other times, shadows
    taken out.

    A shadow or a changed exposure scales all channels alike, and a shadow only darkens. Any colour that the
    surface had within `ASKEW_PX` is no other one: the edges of a texture never lie quite where they were.
    """
    if settled.sum() < MIN_SETTLED_PX:
        return np.zeros(settled.shape)
    now = cv2.GaussianBlur(window.color, (5, 5), free_space.SOFTNESS_PX).astype(np.float32)
    before = votes.color * np.median((now[settled] + 4) / (votes.color[settled] + 4), axis=0)
    scale = np.clip((now * before).sum(-1) / np.maximum((before**2).sum(-1), 1), 0.5, 1.0)
    then, kernel = scale[..., None] * before, np.ones((2 * ASKEW_PX + 1, 2 * ASKEW_PX + 1), np.uint8)
    known = settled[..., None]
    low = np.minimum(cv2.erode(np.where(known, then, np.float32(np.inf)), kernel), then)
    high = np.maximum(cv2.dilate(np.where(known, then, np.float32(-np.inf)), kernel), then)
    difference = np.linalg.norm(np.maximum(np.maximum(low - now, now - high), 0), axis=-1)
    noise = max(float(np.median(difference[settled])), MIN_NOISE)
    return np.where(settled, np.clip(difference / noise - 3, 0, 6), 0)
