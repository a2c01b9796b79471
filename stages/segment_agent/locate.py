"""Where the animal of a session is: a ball per frame, from what moves and, once that is learnt, from what looks like it."""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from pipeline.files.clips import Clip
from pipeline.space import cameras, rigid
from stages.segment_agent import free_space, movers
from stages.segment_agent.free_space import FreeSpace, References
from stages.segment_agent.movers import Candidate, Hint, Mover
from stages.segment_agent.windows import Sphere, supported_depth

COARSE_PX, FINE_PX = 74, 222
"""side of the square that has as many pixels as candidates are made of: without and with known looks"""

Looks = Callable[[int], Float[np.ndarray, "height width"]]
"""log-odds of showing the animal by its looks, of one frame at any resolution"""


def find_mover(
    clip: Clip,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    references: References,
    free: FreeSpace,
    mover: Mover,
    hint: Hint | None,
    looks: Looks | None = None,
) -> list[Sphere | None]:
    """Track the animal of a session: a ball per frame, None where it is out of view.

    Without known looks a hint holds only what hangs together with it; the rest of the track, which may have gone over to
    another mover, is a guess.
    """
    found = [_candidates(clip, frame, world_from_camera[frame], references, free, mover, looks) for frame in range(len(clip))]
    choice = movers.track(found, clip.timestamp_s, mover, hint)
    chosen = [group[index] if index >= 0 else None for group, index in zip(found, choice, strict=True)]
    surely = np.ones(len(clip), bool) if hint is None or looks is not None else movers.connected(chosen, clip.timestamp_s, mover, hint)
    radii = [candidate.radius_m for candidate, sure in zip(chosen, surely, strict=True) if candidate and sure]
    radius = float(np.clip(1.8 * np.quantile(radii, 0.9), 0.15, mover.largest_m)) if radii else 0.0
    balls = [
        Sphere(candidate.centre_world, radius, presumed=not sure) if candidate else None
        for candidate, sure in zip(chosen, surely, strict=True)
    ]
    return presume(balls, clip.timestamp_s, mover)


def presume(balls: list[Sphere | None], timestamp_s: Float[np.ndarray, "frame"], mover: Mover) -> list[Sphere | None]:
    """Fill short gaps of a track between its ends, and a while before and after it, by where the animal may still be."""
    seen = np.array([frame for frame, ball in enumerate(balls) if ball is not None])
    if not len(seen):
        return balls
    centres = np.stack([balls[frame].centre_world for frame in seen])
    guess = np.stack([np.interp(timestamp_s, timestamp_s[seen], centres[:, axis]) for axis in range(3)], axis=1)
    after = np.minimum(np.searchsorted(seen, np.arange(len(balls))), len(seen) - 1)
    wait = np.abs(timestamp_s - timestamp_s[seen[[np.maximum(after - 1, 0), after]]]).min(0)
    radius = balls[seen[0]].radius_m
    return [
        ball or (Sphere(guess[frame], radius, presumed=True) if wait[frame] < mover.presumed_s else None)
        for frame, ball in enumerate(balls)
    ]


def _candidates(
    clip: Clip,
    frame: int,
    world_from_camera: Float[np.ndarray, "4 4"],
    references: References,
    free: FreeSpace,
    mover: Mover,
    looks: Looks | None,
) -> list[Candidate]:
    """Group the points of one frame that move or, where its looks are known, look more like the animal than like the room.

    Known looks leave few points to judge, so all of them are: an animal may show no more than a paw or an ear.
    """
    stride = max(1, round(math.sqrt(math.prod(clip.depth_size)) / (COARSE_PX if looks is None else FINE_PX)))
    chosen = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    if looks is None:
        depth = free_space.usable_depth(clip, frame)[chosen]
    else:
        like = _sampled(looks(frame), clip.depth_size, chosen)
        depth = np.where(like > -mover.clear_motion, supported_depth(clip, frame)[chosen], 0)
    rays = cameras.ray_directions(clip.depth_intrinsics[frame], *clip.depth_size)[chosen]
    points = rigid.apply(world_from_camera, (rays * depth[..., None]).reshape(-1, 3)).reshape(*depth.shape, 3)
    points[depth == 0] = np.nan
    votes = free_space.vote(references, points, free, frame)
    area = (depth * stride) ** 2 / (clip.depth_intrinsics[frame, 0, 0] * clip.depth_intrinsics[frame, 1, 1])
    if looks is None:
        return movers.candidates(movers.moving(votes, mover), np.ones(depth.shape), points, area, mover)
    motion = movers.motion(votes, mover)
    settled = (votes.occupied > 0) & (motion == 0)
    both = np.clip(like, -mover.looks_limit, mover.looks_limit) + motion - mover.settled * settled
    both[depth == 0] = -mover.looks_limit
    return movers.candidates(both > 0, 1 / (1 + np.exp(-both)), points, area, mover)


def _sampled(
    picture: Float[np.ndarray, "height width"], size: tuple[int, int], chosen: tuple[slice, slice]
) -> Float[np.ndarray, "row column"]:
    """Read a picture where the chosen pixels of a picture of another (height, width) lie."""
    at = ((np.arange(side)[part] + 0.5) * (own / side) for side, own, part in zip(size, picture.shape, chosen, strict=True))
    return picture[np.ix_(*(index.astype(int) for index in at))]
