"""Poses for stretches in which no frame shows the agent: where it probably went, and how it probably stood and walked.

They are guesses from its habits, from the shape of the home, and from where the phone looked without seeing it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d

from pipeline.models.motion import DOUBTFUL, INFERRED, Motion, gaps_s
from pipeline.space import rigid
from stages.reconstruct import sightings
from stages.reconstruct.assemble import Video, scene_first
from stages.reconstruct.places import Places, places_of
from stages.reconstruct.problem import Problem
from stages.reconstruct.route import MOVING_M_S, End, Habits, likeliest, runs, speeds_of
from stages.reconstruct.sightings import Stand

LOOK_S = 0.1
"""the phone's looks are read this often ..."""
MOST_LOOKS = 1200
"""... or less, so many in a stretch"""
SMOOTH_S = 0.15
"""standard deviation of the smoothing of ways and postures"""
NEAR = 0.05
"""share of the frames in which the agent is seen nearer to the phone than is believed unseen"""
TURN_S = 0.5
"""before it leaves a place the agent turns, for this long"""


@dataclass(frozen=True)
class Known:
    """All that helps to guess, the same for all stretches."""

    places: Places
    habits: Habits
    stand: Stand
    walk: Float[np.ndarray, "frame bone 4 4"]
    """bones over the longest walk that was seen"""
    walk_m: Float[np.ndarray, "frame"]
    """how far it had come"""
    near_m: float
    """hardly ever is it seen nearer to the phone, along the ground"""


def inferred(problem: Problem, videos: Sequence[Video], motions: Mapping[str, Motion], certain_gap_s: float) -> dict[str, Motion]:
    """Fill hidden stretches of all recordings that show the agent in its home.

    Frames in gaps longer than ``certain_gap_s``, filled here or before, get `INFERRED` confidence.
    """
    ordered = scene_first(videos)
    first = dict(zip((video.id for video in ordered), np.cumsum([0, *(len(video.timestamp_s) for video in ordered)]), strict=False))
    shown = [video.id for video in ordered if video.has_scene and seen(motions[video.id]).any()]
    known = _known(problem, [motions[id] for id in shown]) if shown else None
    return {id: _filled(problem, known, motion, int(first[id]), certain_gap_s) if id in shown else motion for id, motion in motions.items()}


def seen(motion: Motion) -> Bool[np.ndarray, "frame"]:
    """Tell in which frames the agent's pose was seen."""
    return motion.agent_visible & np.isfinite(motion.world_from_agent).all((1, 2))


def _known(problem: Problem, motions: Sequence[Motion]) -> Known:
    when, root, good = zip(*((each.timestamp_s, each.world_from_agent[:, :3, 3], seen(each)) for each in motions), strict=True)
    roots = np.concatenate([place[these] for place, these in zip(root, good, strict=True)])
    walk, walk_m = _longest_walk(motions)
    places = places_of(problem.scene, problem.floor_m, roots)
    apart = np.concatenate(
        [np.linalg.norm((each.world_from_camera - each.world_from_agent)[seen(each)][:, [0, 2], 3], axis=1) for each in motions]
    )
    near_m = float(np.nanquantile(apart, NEAR))
    return Known(places, Habits.of(when, root, good), Stand.of(problem.surface.points.cpu()), walk, walk_m, near_m)


def _longest_walk(motions: Sequence[Motion]) -> tuple[Float[np.ndarray, "frame bone 4 4"], Float[np.ndarray, "frame"]]:
    """Return the bones of the longest way that the agent was seen to go in one, and how far it had come; rest if there is none."""
    best = motions[0].agent_from_bone[:1], np.zeros(1)
    for motion in motions:
        place = motion.world_from_agent[:, :3, 3]
        speed, told = speeds_of(motion.timestamp_s, place, seen(motion))
        for frames in runs(told & (speed > MOVING_M_S)):
            way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place[frames], axis=0), axis=1))])
            if way[-1] > best[1][-1]:
                best = motion.agent_from_bone[frames], way
    return best


def _filled(problem: Problem, known: Known, motion: Motion, first: int, certain_gap_s: float) -> Motion:
    """Fill one recording's stretches, whose frames begin at ``first``."""
    good, when = seen(motion), motion.timestamp_s
    root, bones = motion.world_from_agent.copy(), motion.agent_from_bone.copy()
    unknown = ~np.isfinite(root).all((1, 2))
    for stretch in runs(~good):
        begin, end = max(stretch[0] - 1, 0), min(stretch[-1] + 1, len(when) - 1)
        if unknown[stretch].any():
            place, moves = _way(problem, known, motion, good, first, begin, end)
            ends = [motion.world_from_agent[i] if good[i] else None for i in (begin, end)]
            inside = stretch - begin
            root[stretch] = _roots(when[begin : end + 1], place, moves, *ends)[inside]
            bones[stretch] = _bones(known, motion, good, begin, place, moves)[inside]
    guessed = gaps_s(when, good) > certain_gap_s
    confidence = np.where(guessed, np.minimum(motion.confidence, INFERRED), motion.confidence)
    return replace(motion, world_from_agent=root, agent_from_bone=bones, confidence=confidence)


def _way(
    problem: Problem, known: Known, motion: Motion, good: Bool[np.ndarray, "frame"], first: int, begin: int, end: int
) -> tuple[Float[np.ndarray, "frame 3"], Bool[np.ndarray, "frame"]]:
    """Return where the root is from frame ``begin`` to ``end``, through the ends as they were seen, and whether it moves."""
    when, root = motion.timestamp_s, motion.world_from_agent[:, :3, 3]
    ends = [root[i] if good[i] else None for i in (begin, end)]
    told = [place for place in ends if place is not None]
    reach = sum(np.linalg.norm(known.places.position - place, axis=1) for place in told)
    span = when[end] - when[begin]
    places = known.places.only(reach <= max(1.0, known.habits.fast_m_s * span + 0.5))
    if not len(places.position):
        return rigid.interpolate(when[good], motion.world_from_agent[good], when[begin : end + 1])[:, :3, 3], np.zeros(
            end + 1 - begin, bool
        )
    spacing = max(LOOK_S, span / MOST_LOOKS)
    frames = np.unique([*(begin + np.searchsorted(when[begin:end], np.arange(when[begin], when[end], spacing))), end])
    trusted = np.where((motion.confidence[frames] >= DOUBTFUL)[:, None, None], motion.world_from_camera[frames], np.nan)
    cameras = torch.from_numpy(rigid.inverse(trusted)).float()
    says = sightings.evidence(
        problem.store.views,
        first + frames,
        cameras,
        np.gradient(when[frames]),
        known.stand,
        places.position,
        known.near_m,
    )
    speed, sure = speeds_of(when, root, good)
    ending = [
        None if place is None else End(places.nearest(place), bool(_mode(speed, sure, i)))
        for place, i in zip(ends, (begin, end), strict=True)
    ]
    cell, moves = likeliest(places, known.habits, says, np.diff(when[frames]), *ending)
    return _pinned(when, frames, places.position[cell], ends), moves[np.searchsorted(frames, np.arange(begin, end + 1))]


def _mode(speed: Float[np.ndarray, "frame"], told: Bool[np.ndarray, "frame"], frame: int, around: int = 6) -> bool:
    """Tell whether the agent moves in the frame nearest to this one in which that can be told."""
    near = np.flatnonzero(told[max(frame - around, 0) : frame + around + 1]) + max(frame - around, 0)
    return bool(len(near)) and speed[near[np.abs(near - frame).argmin()]] > MOVING_M_S


def _pinned(
    when: Float[np.ndarray, "frame"], frames: Int[np.ndarray, "look"], place: Float[np.ndarray, "look 3"], ends: Sequence[np.ndarray | None]
) -> Float[np.ndarray, "frame 3"]:
    """Bring cells to all frames, smooth, and carry the ends to where they were seen."""
    around = when[frames[0] : frames[-1] + 1]
    way = np.stack([np.interp(around, when[frames], place[:, axis]) for axis in range(3)], axis=-1)
    way = gaussian_filter1d(way, SMOOTH_S / max(np.median(np.diff(around)), 1e-6), axis=0, mode="nearest")
    off = [np.zeros(3) if end is None else end - way[i] for end, i in zip(ends, (0, -1), strict=True)]
    near = [np.exp(-np.abs(around - around[i]) / TURN_S)[:, None] for i in (0, -1)]
    both = np.exp(-(around[-1] - around[0]) / TURN_S)
    solved = np.linalg.solve(np.array([[1.0, both], [both, 1.0]]), np.stack(off))
    return way + near[0] * solved[0] + near[1] * solved[1]


def _roots(
    when: Float[np.ndarray, "frame"],
    place: Float[np.ndarray, "frame 3"],
    moves: Bool[np.ndarray, "frame"],
    before: Float[np.ndarray, "4 4"] | None,
    after: Float[np.ndarray, "4 4"] | None,
) -> Float[np.ndarray, "frame 4 4"]:
    """Head along the way where it leads on, and keep the tilt of the ends."""
    ends = [(i, pose) for i, pose in ((0, before), (len(when) - 1, after)) if pose is not None]
    step = np.gradient(place, when, axis=0)
    walking = moves & (np.hypot(step[:, 0], step[:, 2]) > MOVING_M_S)
    knots = {i: np.arctan2(step[i, 0], step[i, 2]) for i in np.flatnonzero(walking)} | {i: _yaw(pose) for i, pose in ends}
    for run in runs(~walking)[: len(when)]:  # where it rests it looks as it came, and turns before it goes on
        turn = int(np.searchsorted(when, when[run[-1]] - TURN_S))
        if run[0] - 1 in knots and run[0] < turn < run[-1] and walking.any():
            knots[turn] = knots[run[0] - 1]
    at = np.array(sorted(knots))
    yaw = rigid.rotation_from_vector(np.array([[0.0, knots[i], 0.0] for i in at]))
    upright = rigid.interpolate(when[at], rigid.make(yaw, np.zeros((len(at), 3))), when)[:, :3, :3]
    tilt = np.stack([rigid.rotation_from_vector(np.array([0.0, -_yaw(pose), 0.0])) @ pose[:3, :3] for _, pose in ends])
    tilts = rigid.interpolate(when[[i for i, _ in ends]], rigid.make(tilt, np.zeros((len(ends), 3))), when)[:, :3, :3]
    sigma = SMOOTH_S / max(np.median(np.diff(when)), 1e-6)
    return rigid.smoothed(rigid.make(upright @ tilts, place), sigma, places=False)


def _yaw(pose: Float[np.ndarray, "4 4"]) -> float:
    """Return the angle about the vertical of the way that the agent faces, its +z."""
    return float(np.arctan2(pose[0, 2], pose[2, 2]))


def _bones(
    known: Known,
    motion: Motion,
    good: Bool[np.ndarray, "frame"],
    begin: int,
    place: Float[np.ndarray, "frame 3"],
    moves: Bool[np.ndarray, "frame"],
) -> Float[np.ndarray, "frame bone 4 4"]:
    """Walk as it was seen walking, by the way it makes, and rest as it was seen resting nearest in time."""
    speed, told = speeds_of(motion.timestamp_s, motion.world_from_agent[:, :3, 3], good)
    resting = np.flatnonzero(told & (speed <= MOVING_M_S))
    resting = resting if len(resting) else np.flatnonzero(good)
    frames = begin + np.arange(len(place))
    between = (motion.timestamp_s[resting[1:]] + motion.timestamp_s[resting[:-1]]) / 2
    rests = resting[np.searchsorted(between, motion.timestamp_s[frames])]
    bones = motion.agent_from_bone[rests].copy()
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    there = known.walk_m[-1] - np.abs(way % (2 * max(known.walk_m[-1], 1e-6)) - known.walk_m[-1])  # to its end and back
    bones[moves] = known.walk[np.abs(known.walk_m - there[moves, None]).argmin(1)]
    ends = [i for i in (0, len(place) - 1) if good[frames[i]]]
    bones[ends] = motion.agent_from_bone[frames[ends]]
    sigma = SMOOTH_S / max(np.median(np.diff(motion.timestamp_s)), 1e-6)
    return np.stack([rigid.smoothed(bones[:, bone], sigma) for bone in range(bones.shape[1])], axis=1)
