"""People who walk through a recording: upright movers, taller than an animal.

`find_people` tracks them through the whole recording; `People.near` marks the points that are theirs, so that
neither the animal's track nor its appearance includes their legs.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.core.progress import log
from pipeline.data.clips import Clip
from pipeline.geometry import subsampling
from stages.segment_agent import free_space, movers
from stages.segment_agent.config import AnimalConfig
from stages.segment_agent.free_space import References
from stages.segment_agent.locate import COARSE_PX
from stages.segment_agent.movers import Candidate
from stages.segment_agent.segmenter import Mask

UPRIGHT_M = 0.9
"""minimum vertical extent of a fully visible person; pets are lower"""
MIN_HEIGHT_M = 0.4
"""minimum vertical extent of a partly visible person, such as legs"""
MIN_ASPECT = 1.2
"""minimum ratio of height to width of a person"""
MIN_UPRIGHT_FRAMES = 4
"""frames in which a track must be as high as a person"""
MAX_PEOPLE = 3
BODY_RADIUS_M = 0.125
"""distance of the body axis behind the visible surface: half the depth of a chest"""
REACH_M = 0.45
"""horizontal distance from a person's axis within which points belong to the person"""
HEAD_REACH_M = 0.2
"""horizontal distance from a person's axis within which all points count for the height, moving or not"""
FLOOR_QUANTILE, ABOVE_FLOOR_M = 0.05, 0.06
"""quantile of point heights that is taken as the floor, and least height of a person's points above it"""
DILATION = np.ones((5, 5), np.uint8)
"""dilation of people, depth pixels"""
WALKING_M_S = 1.5
"""walking speed of people in a room"""
HEADING_S, MIN_HEADING_FRAMES = 0.5, 5
"""time before and after a frame whose positions give the walking direction, and least number of these"""
WALKS_M_S, MAX_HEADING_RAD = 0.25, 0.35
"""speed from which a person walks, and so looks ahead; largest standard error of a known heading"""
WALKER = AnimalConfig(largest_m=4.0, speed_m_s=2.5)
"""size and speed of people, for tracking"""


@dataclass(frozen=True)
class People:
    """Tracks of people in a recording's own world, meters, +y up."""

    axis_world: Float[np.ndarray, "person frame 2"]
    """x and z of the body's middle; NaN where a person is not seen"""
    ahead_world: Float[np.ndarray, "person frame 2"]
    """x and z of the walking direction, a unit vector; NaN where a person stands or it is uncertain"""
    height_m: Float[np.ndarray, "person"]
    """above the floor; NaN where the head is never in the picture"""
    floor_m: float
    """height of the floor in the recording's world"""

    def near(self, frame: int, points_world: Float[np.ndarray, "*shape 3"]) -> Bool[np.ndarray, "*shape"]:
        """Return which points belong to a person or touch one."""
        axes = self.axis_world[:, frame]
        axes = axes[np.isfinite(axes[:, 0])]
        off = np.linalg.norm(points_world[..., None, ::2] - axes, axis=-1)
        return (off < REACH_M).any(-1) & (points_world[..., 1] > self.floor_m + ABOVE_FLOOR_M)


def find_people(
    clip: Clip, world_from_camera: Float[np.ndarray, "frame 4 4"], references: References
) -> People:
    """Track all people of a session through its frames."""
    scanned = [_upright(clip, frame, world_from_camera[frame], references) for frame in range(len(clip))]
    lowest = np.concatenate([low for _, low in scanned])
    floor_m = float(np.median(lowest)) if len(lowest) else 0.0
    found = [group for group, _ in scanned]
    axes, ahead, heights = [], [], []
    for _ in range(MAX_PEOPLE):
        picked = movers.track(found, clip.timestamp_s, WALKER)
        person = _persistent(picked, clip.timestamp_s)
        if not person.any():
            break
        axis, tops = np.full((len(clip), 2), np.nan), []
        for frame in np.flatnonzero(person):
            mover = picked[frame]
            assert mover is not None, "a person's frames have a mover"
            axis[frame] = mover.center_world[[0, 2]]
            tops += [mover.top_m] if mover.whole else []
            found[frame].remove(mover)
        axes.append(_fill_gaps(axis, clip.timestamp_s))
        ahead.append(walking_direction(axis, clip.timestamp_s))
        heights.append(float(np.quantile(tops, 0.9)) - floor_m if len(tops) >= MIN_UPRIGHT_FRAMES else np.nan)
    axis_world, ahead_world = (np.array(each).reshape(-1, len(clip), 2) for each in (axes, ahead))
    return People(axis_world, ahead_world, np.array(heights, float), floor_m)


def gather_without_people(
    clip: Clip, world_from_camera: Float[np.ndarray, "frame 4 4"], count: int
) -> tuple[References, People]:
    """Gather ``count`` references, find people by them, and make the references ignore people's motion."""
    references = free_space.gather(clip, world_from_camera, count)
    people = find_people(clip, world_from_camera, references)
    for axis, height_m in zip(people.axis_world, people.height_m, strict=True):
        tall = "" if np.isnan(height_m) else f", {height_m:.2f} m tall"
        log(f"a person walks here, seen in {np.isfinite(axis[:, 0]).sum()} of {len(clip)} frames{tall}")
    return replace(references, ignored=people.near if len(people.axis_world) else None), people


@dataclass(frozen=True, eq=False)
class UprightMover(Candidate):
    """A group of moving points that is higher than wide."""

    extent_m: float = 0.0
    """vertical"""
    top_m: float = 0.0
    """height of its highest points in the recording's world"""
    whole: bool = False
    """whether its top is within the picture"""


def _upright(
    clip: Clip, frame: int, world_from_camera: Float[np.ndarray, "4 4"], references: References
) -> tuple[list[UprightMover], Float[np.ndarray, "height"]]:
    """Return the upright groups of moving points of a frame, and the height of low surfaces."""
    inner = free_space.interior_depth(clip, frame)
    points, area, _ = free_space.sample(clip, frame, world_from_camera, inner, COARSE_PX)
    heights = points[area > 0, 1]
    low = np.quantile(heights, [FLOOR_QUANTILE]) if len(heights) else np.zeros(0)
    moving = movers.moving(free_space.vote(references, points, frame))
    found = []
    for own in movers.components(moving):
        group = points[own]
        bottom, top = np.quantile(group[:, 1], [0.02, 0.98])
        width = np.ptp(np.quantile(group[:, [0, 2]], [0.1, 0.9], axis=0), axis=0).max()
        if top - bottom < max(MIN_HEIGHT_M, MIN_ASPECT * width):
            continue
        center = np.median(group, axis=0)
        away = (center - world_from_camera[:3, 3]) * [1, 0, 1]
        center += BODY_RADIUS_M * away / max(float(np.linalg.norm(away)), BODY_RADIUS_M)
        radius = float(np.quantile(np.linalg.norm(group - center, axis=1), 0.95))
        upright = (np.linalg.norm((points - center)[..., ::2], axis=-1) < HEAD_REACH_M) & (area > 0)
        whole = bool(np.nonzero(own | upright)[0].min() > 1)
        size = {"extent_m": float(top - bottom), "whole": whole}
        size["top_m"] = float(points[own | upright, 1].max())
        found.append(UprightMover(center, float(area[own].sum()), radius, **size))
    return found, low


def _persistent(
    picked: Sequence[UprightMover | None], timestamp_s: Float[np.ndarray, "frame"]
) -> Bool[np.ndarray, "frame"]:
    """Return the frames of a track that certainly show a person: segments that are often tall enough, and
    neighboring segments that the same person can have reached."""
    person = np.zeros(len(picked), bool)
    own = movers.segments(picked, timestamp_s, WALKER)
    tall = np.array([mover is not None and mover.extent_m > UPRIGHT_M for mover in picked])
    is_person = [int(tall[frames].sum()) >= MIN_UPRIGHT_FRAMES for frames in own]
    place = np.array([[np.nan] * 3 if mover is None else mover.center_world for mover in picked])
    for step in (1, -1):
        for number, following in pairwise(range(len(own))[::step]):
            ends = [own[number][-1 if step > 0 else 0], own[following][0 if step > 0 else -1]]
            gap_s = float(np.ptp(timestamp_s[ends]))
            off_m = np.linalg.norm((place[ends[1]] - place[ends[0]])[[0, 2]])
            near = off_m < movers.JUMP_M + REACH_M + WALKING_M_S * gap_s
            is_person[following] |= is_person[number] and gap_s < movers.PRESUMED_S and bool(near)
    for frames, yes in zip(own, is_person, strict=True):
        person[frames] = yes
    return person


def _fill_gaps(
    axis: Float[np.ndarray, "frame 2"], timestamp_s: Float[np.ndarray, "frame"]
) -> Float[np.ndarray, "frame 2"]:
    """Interpolate short gaps of a track, in which a person stood still or before unknown depth."""
    seen = np.isfinite(axis[:, 0])
    filled = np.stack([np.interp(timestamp_s, timestamp_s[seen], axis[seen, k]) for k in range(2)], axis=-1)
    short = subsampling.within_short_gaps(timestamp_s[seen], timestamp_s, movers.ABSENT_S)
    return np.where(short[:, None], filled, axis)


def walking_direction(
    axis: Float[np.ndarray, "frame 2"], timestamp_s: Float[np.ndarray, "frame"]
) -> Float[np.ndarray, "frame 2"]:
    """Return the direction in which positions move, by a line fitted to those around each frame.

    NaN where it is slower than a walk, or its standard error, from the scatter about the line, is large.
    """
    ahead, seen = np.full_like(axis, np.nan), np.isfinite(axis[:, 0])
    for frame in np.flatnonzero(seen):
        near = seen & (np.abs(timestamp_s - timestamp_s[frame]) <= HEADING_S)
        time, place = timestamp_s[near] - timestamp_s[near].mean(), axis[near] - axis[near].mean(0)
        spread = float((time**2).sum())
        if near.sum() < MIN_HEADING_FRAMES or spread == 0:
            continue
        velocity = time @ place / spread
        speed = float(np.linalg.norm(velocity))
        scatter = ((place - time[:, None] * velocity) ** 2).sum() / (2 * (len(time) - 2))
        if speed > WALKS_M_S and np.sqrt(scatter / spread) < MAX_HEADING_RAD * speed:
            ahead[frame] = velocity / speed
    return ahead


def hide(
    masks: Iterable[Mask], people: People, clip: Clip, world_from_camera: Float[np.ndarray, "frame 4 4"]
) -> Iterator[Mask]:
    """Mark people as unknown in all masks: neither animal nor background."""
    for frame, mask in enumerate(masks):
        if not np.isfinite(people.axis_world[:, frame]).any():
            yield mask
            continue
        points = free_space.world_points(clip, frame, world_from_camera[frame], clip.depth(frame), 1)
        theirs = people.near(frame, points)
        theirs = cv2.dilate(theirs.astype(np.uint8), DILATION)
        theirs = cv2.resize(theirs, mask.labels.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        yield replace(mask, labels=np.where(theirs & (mask.labels == 0), np.uint8(128), mask.labels))
