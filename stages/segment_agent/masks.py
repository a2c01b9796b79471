"""Masks of one recording from its pictures alone: the steps of this stage in order."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, assert_never

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.core.errors import InputError
from pipeline.data.clips import Clip
from pipeline.geometry import subsampling
from stages.segment_agent import free_space, movers, people
from stages.segment_agent import prompt as prompts
from stages.segment_agent.appearance import Appearance, Example, learn
from stages.segment_agent.config import Config
from stages.segment_agent.evidence import either, judge_motion
from stages.segment_agent.follow import follow
from stages.segment_agent.footage import Footage
from stages.segment_agent.free_space import References
from stages.segment_agent.locate import AppearanceOf, find_mover
from stages.segment_agent.movers import Hint
from stages.segment_agent.overlap import Shown
from stages.segment_agent.painting import Mask, Painter, learn_palette
from stages.segment_agent.people import People
from stages.segment_agent.prompt import Prompt
from stages.segment_agent.refine import Palette
from stages.segment_agent.resting import find_resting, rests
from stages.segment_agent.trajectory import CameraPath, steady
from stages.segment_agent.turnaround import EDGES, find_standing, meeting_point
from stages.segment_agent.windows import Sphere, rectangle, working_picture, working_size

EMPTY_SHARE = 3
"""times as many pictures with the animal as without it are learned from"""
KNOWN_SHARE = 0.6
"""of the animal that a network was shown, which it must find: one that learned too little would only veto"""
GUESSED = 2.0
"""times its size that the animal is looked for where its place is a guess, once its appearance is known"""
STILL_STRIDE = 3
"""pixels of depth between samples that decide where a frame without a track may show something that moves"""
PROBES = 12
"""frames that are looked at where a few suffice"""
RIM = np.ones((5, 5), np.uint8)
"""what may still be animal around what looks like it or moves, pixels or samples"""


@dataclass(frozen=True)
class Segmentation:
    """What is found in a recording."""

    masks: Iterator[Mask]
    """One per frame, made as they are asked for."""
    path: CameraPath | None = None
    """Camera poses; None without depth."""
    walkers: People | None = None
    """People in a session with depth."""
    strangers: float | None = None
    """Share of frames in which something moves about that is none of several animals."""
    references: References | None = None
    """Depth pictures that judge the masks; None without depth."""
    shown: Shown = "mover"
    """What the masks are of."""


def segment(
    clip: Clip,
    flow: Path,
    role: Literal["turnaround", "session"],
    hint: Prompt | None,
    config: Config,
    rng: np.random.Generator,
) -> Segmentation:
    """Return one mask per frame, made as they are asked for, the poses they rest on, and people.

    ``flow`` is the recording's flow folder. A recording without any depth is followed from its hint, with no
    poses.

    Raises:
        InputError: MSK-004 without depth and hint; MSK-002, MSK-003 where hint or cameras point at nothing.
    """
    probes = subsampling.evenly(len(clip), PROBES).tolist()
    if not any((clip.depth(frame) > 0).any() for frame in probes):
        if hint is None:
            what = "there is no depth, so motion alone does not separate the animal from the room"
            remedy = "give a hint: one box around the animal in one frame (<recording>.prompt.toml)"
            raise InputError("MSK-004", what, str(clip.folder), remedy)
        return Segmentation(follow(Footage(clip, flow, config.height_px), hint, config.learning, rng))
    path = steady(clip, flow, rng)
    poses = path.world_from_camera
    mark = None if hint is None else prompts.place(hint, clip, poses)
    match role:
        case "turnaround":
            masks = _standing(clip, poses, mark, config).masks(range(len(clip)))
            references = free_space.gather(clip, poses, config.references)
            return Segmentation(masks, path, references=references, shown="rester")
        case "session":
            references, walkers = people.set_apart(clip, poses, config.references)
            painter = _moving(clip, poses, references, mark, config, rng)
            masks = people.hide(painter.masks(range(len(clip))), walkers, clip, poses)
            shown = "mover" if mark is None else "rester"
            return Segmentation(masks, path, walkers, references=references, shown=shown)
        case _:
            assert_never(role)


def painter_of_turnaround(clip: Clip, flow: Path, config: Config, rng: np.random.Generator) -> Painter:
    """Prepare the masks of a turnaround without a hint; raises MSK-003 as `segment` does."""
    return _standing(clip, steady(clip, flow, rng).world_from_camera, None, config)


def _standing(
    clip: Clip, poses: Float[np.ndarray, "frame 4 4"], mark: Hint | None, config: Config
) -> Painter:
    """Prepare the masks of a turnaround: what stands on the ground where all cameras look."""
    focus = meeting_point(poses) if mark is None else mark.centre_world
    balls, judge = find_standing(clip, poses, focus)
    painter = Painter(clip, poses, balls, judge, config.height_px, Palette(), EDGES)
    return replace(painter, appearance=learn_palette(painter))


def _moving(
    clip: Clip,
    poses: Float[np.ndarray, "frame 4 4"],
    references: References,
    mark: Hint | None,
    config: Config,
    rng: np.random.Generator,
) -> Painter:
    """Prepare the masks of a session: motion first, then the appearance that it teaches, then both."""
    balls = find_mover(clip, poses, references, config.animal, mark)
    judge, resting = judge_motion(references), None
    held = any(ball is not None and not ball.presumed for ball in balls)
    if mark is not None and (not held or rests(clip, poses, references, mark)):
        balls, resting = find_resting(clip, poses, mark, config.height_px, rng)
        judge = resting
    painter = Painter(clip, poses, balls, judge, config.height_px, Palette())
    painter = replace(painter, appearance=learn_palette(painter))
    network = learn_appearance(painter, references, config, rng)
    if network is None:
        return painter
    room = free_space.without(references, lambda frame: hidden(painter, frame, network))
    found = find_mover(clip, poses, room, config.animal, mark, appearance_of(painter, network))
    balls = resized(found, balls)
    judge = judge_motion(room) if resting is None else either(resting, judge_motion(room))
    return Painter(clip, poses, balls, judge, config.height_px, network)


def resized(balls: list[Sphere | None], first: list[Sphere | None]) -> list[Sphere | None]:
    """Give the balls of a track by appearance the size that motion alone found: furniture may touch it."""
    radius_m = next(ball.radius_m for ball in first if ball is not None)
    return [ball and replace(ball, radius_m=radius_m * (GUESSED if ball.presumed else 1)) for ball in balls]


def appearance_of(painter: Painter, network: Appearance) -> AppearanceOf:
    """Return the log-odds of a network at working resolution, frame by frame."""
    return lambda frame: network.log_odds(painter.working_picture(frame))


@dataclass(frozen=True)
class Known:
    """What other recordings showed of an animal."""

    examples: Sequence[Example]
    """pictures of it"""
    recognized: AppearanceOf
    """log-odds of its appearance there; near where it is tracked, what is recognized is not taken for room"""


def learn_appearance(
    painter: Painter,
    references: References,
    config: Config,
    rng: np.random.Generator,
    known: Known | None = None,
) -> Appearance | None:
    """Learn the appearance of animal and room from first masks and from what is known of other recordings.

    None where the animal is never seen, or not learned well enough to judge.
    """
    seen = np.array([frame for frame, ball in enumerate(painter.balls) if _certain(ball)])
    if not len(seen):
        return None
    chosen = seen[subsampling.evenly(len(seen), config.learning.examples, rounded=True)]
    shown = []
    for frame in chosen.tolist():
        labels = painter.working_mask(frame).labels
        if known is not None:
            unsure = (labels == 0) & _sought(painter, frame, labels.shape) & (known.recognized(frame) > 0)
            labels = np.where(unsure, np.uint8(128), labels)
        shown.append(Example(painter.working_picture(frame), labels))
    empty = [frame for frame, ball in enumerate(painter.balls) if not _certain(ball)]
    room = [
        Example(working_picture(painter.clip, frame, painter.height_px), _still(painter, references, frame))
        for frame in empty[:: max(1, -(-len(empty) * EMPTY_SHARE // len(shown)))]
    ]
    elsewhere = () if known is None else known.examples
    network = learn([*shown, *elsewhere], config.learning, rng, room=room)
    if network is None or not _knows(network, shown[:: max(1, len(shown) // PROBES)]):
        return None
    return network


def _still(painter: Painter, references: References, frame: int) -> UInt8[np.ndarray, "height width"]:
    """Label a frame in which nothing was tracked: room, but for what may move unnoticed, which is unknown.

    An animal that rests unnoticed is outvoted by the frames in which it moves.
    """
    clip, pose = painter.clip, painter.world_from_camera[frame]
    points = free_space.points_of(clip, frame, pose, free_space.steady_depth(clip, frame), STILL_STRIDE)
    moving = movers.moving(free_space.vote(references, points, frame))
    size, near = working_size(clip, painter.height_px), cv2.dilate(moving.astype(np.uint8), RIM)
    return cv2.resize(near, size[::-1], interpolation=cv2.INTER_NEAREST) * np.uint8(128)


def _certain(ball: Sphere | None) -> bool:
    return ball is not None and not ball.presumed


def _knows(network: Appearance, examples: list[Example]) -> bool:
    """Return whether a network finds most of the animal that it was shown."""
    shown = [
        (network.log_odds(each.color)[each.labels == 255] > 0).mean()
        for each in examples
        if (each.labels == 255).any()
    ]
    return bool(shown) and float(np.mean(shown)) > KNOWN_SHARE


def hidden(painter: Painter, frame: int, network: Appearance) -> Bool[np.ndarray, "height width"]:
    """Mark where the animal, by its appearance, hides the room: near where it was seen to move, if it was."""
    color = painter.working_picture(frame)
    like = network.log_odds(color) > 0
    if _certain(painter.balls[frame]):
        like &= _sought(painter, frame, color.shape[:2])
    return cv2.dilate(like.astype(np.uint8), RIM) > 0


def _sought(painter: Painter, frame: int, size: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """Mark the rectangle in which the animal is looked for."""
    inside, ball = np.zeros(size, bool), painter.balls[frame]
    if ball is not None:
        rows, columns = rectangle(painter.clip, frame, painter.world_from_camera[frame], ball, size)
        inside[rows, columns] = True
    return inside
