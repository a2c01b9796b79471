"""Localization of a session's animal: a sphere per frame, from motion and, once learned, appearance."""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from pipeline.data.clips import Clip
from pipeline.geometry import cameras
from pipeline.geometry.flying_pixels import supported
from stages.segment_agent import free_space, identity, movers
from stages.segment_agent.config import AnimalConfig
from stages.segment_agent.free_space import References, Votes
from stages.segment_agent.movers import Candidate, PlacedPrompt
from stages.segment_agent.windows import Sphere, snap_depth_steps

COARSE_PX, FINE_PX = 111, 222
"""square root of the number of depth samples per frame, without and with known appearance"""
SCALE, MIN_RADIUS_M = 1.8, 0.15
"""radius of the sphere over that of candidates, which show one side of the animal; smallest radius"""
OPENING = np.ones((2, 2), np.uint8)
"""opening that removes rims of furniture due to pose error, samples"""

AppearanceOf = Callable[[int], Float[np.ndarray, "height width"]]
"""log-odds of the animal's appearance in one frame, at any resolution"""


def find_mover(
    clip: Clip,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    references: References,
    animal: AnimalConfig,
    prompt: PlacedPrompt | None,
    appearance: AppearanceOf | None = None,
    margin_of: AppearanceOf | None = None,
) -> list[Sphere | None]:
    """Track the animal of a session: a sphere per frame, None where it is out of view.

    Without known appearance, only the part of the track connected to a prompt is certain; the rest may have
    switched to another mover and is presumed. ``margin_of`` gives log-odds against a home's other animals.
    """
    for share in movers.SURE_SHARES if appearance is None else (0.0,):
        found = [
            _candidates(clip, frame, pose, references, animal, (appearance, margin_of), share)
            for frame, pose in enumerate(world_from_camera)
        ]
        chosen = movers.track(found, clip.timestamp_s, animal, prompt)
        seen = np.array([candidate is not None for candidate in chosen])
        if appearance is not None:
            reliable = movers.plausible(chosen, clip.timestamp_s, animal)
        elif prompt is None:
            reliable = movers.self_moving(chosen, clip.timestamp_s, animal)
        else:
            reliable = movers.connected_to_prompt(chosen, clip.timestamp_s, animal, prompt)
        if reliable.any():
            break
    if prompt is None and not reliable.any():
        reliable = seen
    radii = [each.radius_m for each, sure in zip(chosen, reliable, strict=True) if each and sure]
    radius = float(np.clip(SCALE * np.quantile(radii, 0.9), MIN_RADIUS_M, animal.largest_m)) if radii else 0.0
    spheres = [
        Sphere(candidate.center_world, radius, presumed=not sure) if candidate else None
        for candidate, sure in zip(chosen, reliable, strict=True)
    ]
    return fill_gaps(spheres, clip.timestamp_s)


def fill_gaps(spheres: list[Sphere | None], timestamp_s: Float[np.ndarray, "frame"]) -> list[Sphere | None]:
    """Interpolate short gaps of a track and extend its ends for a while, as presumed spheres."""
    seen = np.array([frame for frame, sphere in enumerate(spheres) if sphere is not None])
    if not len(seen):
        return spheres
    centers = np.stack([spheres[frame].center_world for frame in seen])
    guess = np.stack([np.interp(timestamp_s, timestamp_s[seen], axis) for axis in centers.T], axis=1)
    after = np.minimum(np.searchsorted(seen, np.arange(len(spheres))), len(seen) - 1)
    wait = np.abs(timestamp_s - timestamp_s[seen[[np.maximum(after - 1, 0), after]]]).min(0)
    radius = spheres[seen[0]].radius_m
    return [
        sphere or (Sphere(guess[frame], radius, presumed=True) if wait[frame] < movers.PRESUMED_S else None)
        for frame, sphere in enumerate(spheres)
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
    """Group the points of one frame that move or, if the appearance is known, are likely the animal.

    A known appearance leaves few points, so depth at edges counts too: only a paw or an ear may be visible.
    ``known`` are the log-odds of its appearance and against other animals, if any.
    """
    appearance, margin_of = known
    if appearance is None:
        wanted_px, whole = COARSE_PX, free_space.interior_depth(clip, frame)
    else:  # thin things too
        wanted_px, sharp = FINE_PX, snap_depth_steps(clip.depth(frame))
        whole = np.where(supported(sharp), sharp, 0)
    points, area, chosen = free_space.sample(clip, frame, world_from_camera, whole, wanted_px)
    if appearance is not None:
        log_ratio = resample_nearest(appearance(frame), clip.depth_size, chosen)
        area = np.where(log_ratio > -movers.CLEAR_MOTION, area, 0)
        points[area == 0] = np.nan
    votes = free_space.vote(references, points, frame)
    through = partial(free_space.seen_through, references, frame=frame)
    if appearance is None:
        own, probability = opened_motion(votes, share), np.ones(area.shape)
        if margin_of is not None:
            margins = resample_nearest(margin_of(frame), clip.depth_size, chosen)
            own, probability = identity.select_animal(own, margins)
        return movers.candidates(own, probability, points, area, animal, through)
    motion = movers.motion_log_odds(votes)
    if clip.mapped and margin_of is None:  # pictures that differ from the map show resting animals too
        motion = np.maximum(motion, movers.MOTION * (clip.foreground(frame)[chosen] > 0))
    static = (votes.occupied > 0) & (motion == 0)
    limited = np.clip(log_ratio, -movers.APPEARANCE_LIMIT, movers.APPEARANCE_LIMIT)
    both = limited + motion - movers.STATIC_PENALTY * static
    if margin_of is not None:
        both += np.minimum(resample_nearest(margin_of(frame), clip.depth_size, chosen), 0)
    both[area == 0] = -movers.APPEARANCE_LIMIT
    return movers.candidates(both > 0, 1 / (1 + np.exp(-both)), points, area, animal, through, motion > 0)


def opened_motion(votes: Votes, share: float) -> Bool[np.ndarray, "row column"]:
    """Return the samples in space that is free at a good share of other times, morphologically opened."""
    reliable = (votes.free > movers.MIN_VOTES) & (votes.free >= share * votes.occupied)
    opened = cv2.dilate(cv2.erode(reliable.astype(np.uint8), OPENING), OPENING[::-1, ::-1], anchor=(0, 0))
    return reliable & (opened > 0)


def resample_nearest(
    picture: Shaped[np.ndarray, "height width"], size: tuple[int, int], chosen: tuple[slice, slice]
) -> Shaped[np.ndarray, "row column"]:
    """Sample a picture at chosen pixels of a grid of another ``size`` (height, width), nearest neighbor."""
    pixel = cameras.pixel_grid(*size)[chosen] * np.divide(picture.shape, size)[::-1]
    return cameras.sample_nearest(picture, pixel)
