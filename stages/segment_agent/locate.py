"""Where the animal of a session is: a ball per frame, by what moves and, once learned, by its looks."""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from pipeline.data.clips import Clip
from stages.segment_agent import free_space, identity, movers
from stages.segment_agent.config import AnimalConfig
from stages.segment_agent.free_space import References, Votes
from stages.segment_agent.movers import Candidate, Hint
from stages.segment_agent.windows import Sphere, supported_depth

COARSE_PX, FINE_PX = 111, 222
"""side of the square that has as many pixels as candidates are made of: without and with known appearance"""
REACH, MIN_REACH_M = 1.8, 0.15
"""radius of the ball in those of candidates, which show one side of the animal; no ball is smaller"""
SOLID = np.ones((2, 2), np.uint8)
"""samples that an animal fills together; rims of furniture that poses misplace are thinner"""

AppearanceOf = Callable[[int], Float[np.ndarray, "height width"]]
"""log-odds of showing the animal by its appearance, of one frame at any resolution"""


def find_mover(
    clip: Clip,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    references: References,
    animal: AnimalConfig,
    hint: Hint | None,
    appearance: AppearanceOf | None = None,
    apart: AppearanceOf | None = None,
) -> list[Sphere | None]:
    """Track the animal of a session: a ball per frame, None where it is out of view.

    Without known appearance a hint holds only what hangs together with it; the rest of the track, which may
    have gone over to another mover, is a guess. ``apart`` are log-odds against a home's other animals.
    """
    for share in movers.SURE_SHARES if appearance is None else (0.0,):
        found = [
            _candidates(clip, frame, world_from_camera[frame], references, animal, (appearance, apart), share)
            for frame in range(len(clip))
        ]
        choice = movers.track(found, clip.timestamp_s, animal, hint)
        chosen = [group[index] if index >= 0 else None for group, index in zip(found, choice, strict=True)]
        seen = np.array([candidate is not None for candidate in chosen])
        if appearance is not None:
            surely = seen
        elif hint is None:
            surely = movers.self_moving(chosen, clip.timestamp_s, animal)
        else:
            surely = movers.connected(chosen, clip.timestamp_s, animal, hint)
        if surely.any():
            break
    if hint is None and not surely.any():
        surely = seen
    radii = [candidate.radius_m for candidate, sure in zip(chosen, surely, strict=True) if candidate and sure]
    radius = float(np.clip(REACH * np.quantile(radii, 0.9), MIN_REACH_M, animal.largest_m)) if radii else 0.0
    balls = [
        Sphere(candidate.centre_world, radius, presumed=not sure) if candidate else None
        for candidate, sure in zip(chosen, surely, strict=True)
    ]
    return presume(balls, clip.timestamp_s)


def presume(balls: list[Sphere | None], timestamp_s: Float[np.ndarray, "frame"]) -> list[Sphere | None]:
    """Fill short gaps of a track, and a while before and after it, by where the animal may still be."""
    seen = np.array([frame for frame, ball in enumerate(balls) if ball is not None])
    if not len(seen):
        return balls
    centres = np.stack([balls[frame].centre_world for frame in seen])
    guess = np.stack([np.interp(timestamp_s, timestamp_s[seen], axis) for axis in centres.T], axis=1)
    after = np.minimum(np.searchsorted(seen, np.arange(len(balls))), len(seen) - 1)
    wait = np.abs(timestamp_s - timestamp_s[seen[[np.maximum(after - 1, 0), after]]]).min(0)
    radius = balls[seen[0]].radius_m
    return [
        ball or (Sphere(guess[frame], radius, presumed=True) if wait[frame] < movers.PRESUMED_S else None)
        for frame, ball in enumerate(balls)
    ]


def _candidates(
    clip: Clip,
    frame: int,
    world_from_camera: Float[np.ndarray, "4 4"],
    references: References,
    animal: AnimalConfig,
    known: tuple[AppearanceOf | None, AppearanceOf | None],
    share: float,
) -> list[Candidate]:
    """Group the points of one frame that move or, if its appearance is known, look rather like the animal.

    A known appearance leaves few points to judge, so all of them are: an animal may show no more than a paw
    or an ear. ``known`` are its appearance and what distinguishes it from other animals, if any.
    """
    appearance, apart = known
    wanted_px = COARSE_PX if appearance is None else FINE_PX
    whole = free_space.inner_depth(clip, frame) if appearance is None else supported_depth(clip, frame)
    points, area, chosen = free_space.sample(clip, frame, world_from_camera, whole, wanted_px)
    if appearance is not None:
        like = sampled(appearance(frame), clip.depth_size, chosen)
        area = np.where(like > -movers.CLEAR_MOTION, area, 0)
        points[area == 0] = np.nan
    votes = free_space.vote(references, points, frame)
    if appearance is None:
        moving = solid(votes, share)
        if apart is None:
            return movers.candidates(moving, np.ones(area.shape), points, area, animal)
        own, probability = identity.of_one(moving, sampled(apart(frame), clip.depth_size, chosen))
        return movers.candidates(own, probability, points, area, animal)
    motion = movers.motion(votes)
    settled = (votes.occupied > 0) & (motion == 0)
    limited = np.clip(like, -movers.APPEARANCE_LIMIT, movers.APPEARANCE_LIMIT)
    both = limited + motion - movers.SETTLED * settled
    if apart is not None:
        both += np.minimum(sampled(apart(frame), clip.depth_size, chosen), 0)
    both[area == 0] = -movers.APPEARANCE_LIMIT
    return movers.candidates(both > 0, 1 / (1 + np.exp(-both)), points, area, animal)


def solid(votes: Votes, share: float) -> Bool[np.ndarray, "row column"]:
    """Return which samples surely move, but for what is thinner than `SOLID`."""
    surely = movers.surely_moving(votes, share)
    opened = cv2.dilate(cv2.erode(surely.astype(np.uint8), SOLID), SOLID[::-1, ::-1], anchor=(0, 0))
    return surely & (opened > 0)


def sampled(
    picture: Shaped[np.ndarray, "height width"], size: tuple[int, int], chosen: tuple[slice, slice]
) -> Shaped[np.ndarray, "row column"]:
    """Read a picture where the chosen pixels of a picture of another (height, width) lie."""
    sides = zip(size, picture.shape, chosen, strict=True)
    at = (((np.arange(side)[part] + 0.5) * (own / side)).astype(int) for side, own, part in sides)
    return picture[np.ix_(*at)]
