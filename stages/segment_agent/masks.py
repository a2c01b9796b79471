"""Masks of one recording from its pictures alone: the steps of this room in order."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, assert_never

import cv2
import numpy as np
from jaxtyping import Bool

from pipeline.errors import InputError
from pipeline.files.clips import Clip
from pipeline.space.straightening import Straightening
from stages.segment_agent import free_space
from stages.segment_agent import prompt as prompts
from stages.segment_agent.appearance import Appearance, Example, Learning, learn
from stages.segment_agent.evidence import Judge, Weighing, either, judge_motion
from stages.segment_agent.follow import Following, Footage, follow
from stages.segment_agent.free_space import FreeSpace, References
from stages.segment_agent.locate import find_mover
from stages.segment_agent.movers import Hint, Mover
from stages.segment_agent.painting import Mask, Painter, learn_palette
from stages.segment_agent.prompt import Prompt
from stages.segment_agent.refine import Palette, Refinement
from stages.segment_agent.resting import find_resting, rests
from stages.segment_agent.trajectory import Trajectory, steady
from stages.segment_agent.turnaround import Turnaround, find_standing, meeting_point
from stages.segment_agent.windows import Sphere, rectangle, working_picture

GUESSED = 2.0
"""times its size that the animal is looked for where its place is a guess, once its looks are known"""


@dataclass(frozen=True)
class Options:
    """How the animal is found; each table belongs to one file of this room."""

    straightening: Straightening = field(default_factory=Straightening)
    """Drift of the phone's poses and its repair."""
    free_space: FreeSpace = field(default_factory=FreeSpace)
    """How other frames judge a point."""
    mover: Mover = field(default_factory=Mover)
    """What an animal may be like and how it moves."""
    weighing: Weighing = field(default_factory=Weighing)
    """What observations of a session are worth."""
    turnaround: Turnaround = field(default_factory=Turnaround)
    """How a standing animal is told from its ground."""
    learning: Learning = field(default_factory=Learning)
    """How the animal's looks are learnt from first masks."""
    following: Following = field(default_factory=Following)
    """How an animal is followed in a recording without depth."""
    refinement: Refinement = field(default_factory=Refinement)
    """How evidence becomes a mask."""


def segment(
    clip: Clip, flow: Path, role: Literal["turnaround", "session"], hint: Prompt | None, options: Options, rng: np.random.Generator
) -> tuple[Iterator[Mask], Trajectory | None]:
    """Return one mask per frame, made as they are asked for, and the poses they rest on. ``flow`` is the recording's flow folder.

    A recording without any depth is followed from its hint, with no poses; raises InputError MSK-004 without a hint.
    """
    if not _has_depth(clip):
        if hint is None:
            raise InputError(
                "MSK-004",
                "there is no depth, so motion alone does not tell the animal from the room",
                str(clip.folder),
                "give a hint: one box around the animal in one frame (<recording>.prompt.toml)",
            )
        footage = Footage(clip, flow, options.refinement.height_px)
        return follow(footage, hint, options.following, options.learning, rng), None
    path = steady(clip, flow, options.straightening, rng)
    poses = path.world_from_camera
    mark = None if hint is None else prompts.place(hint, clip, poses)
    match role:
        case "turnaround":
            focus = meeting_point(poses, options.turnaround) if mark is None else mark.centre_world
            balls, judge = find_standing(clip, poses, options.turnaround, focus)
            edges = replace(options.refinement, radius_px=options.turnaround.radius_px, unsure=options.turnaround.unsure)
            options = replace(options, refinement=edges)
            looks = learn_palette(Painter(clip, poses, balls, judge, options.refinement, Palette()))
        case "session":
            references = free_space.gather(clip, poses, options.free_space)
            balls, judge = _locate(clip, poses, references, options, mark, None)
            still = None
            if mark is not None and (not _held(balls) or rests(clip, poses, references, options.free_space, options.mover, mark)):
                balls, still = find_resting(clip, poses, mark, options.turnaround, options.refinement.height_px, rng)
                judge = still
            painter = Painter(clip, poses, balls, judge, options.refinement, Palette())
            network = _learn(painter, options, rng)
            looks = Palette() if network is None else network
            if network is not None:
                room = free_space.without(references, lambda frame: _hidden(painter, frame, network), options.free_space)
                radius_m = next(ball.radius_m for ball in balls if ball is not None)
                balls, judge = _locate(clip, poses, room, options, mark, network)
                # rims of furniture may touch what looks like the animal: how large it is, motion alone tells better
                balls = [ball and replace(ball, radius_m=radius_m * (GUESSED if ball.presumed else 1)) for ball in balls]
                judge = judge if still is None else either(still, judge)
        case _:
            assert_never(role)
    painter = Painter(clip, poses, balls, judge, options.refinement, looks)
    return painter.masks(range(len(clip))), path


def _held(balls: list[Sphere | None]) -> bool:
    """Tell whether any ball is more than a guess."""
    return any(ball is not None and not ball.presumed for ball in balls)


def _has_depth(clip: Clip, probes: int = 12) -> bool:
    return any((clip.depth(frame) > 0).any() for frame in np.unique(np.linspace(0, len(clip) - 1, probes).astype(int)).tolist())


def _locate(
    clip: Clip, poses: np.ndarray, references: References, options: Options, hint: Hint | None, network: Appearance | None
) -> tuple[list[Sphere | None], Judge]:
    """Track the animal of a session by its motion, and by its looks when they are known."""
    height_px = options.refinement.height_px
    looks = None if network is None else (lambda frame: network.log_odds(working_picture(clip, frame, height_px)))
    balls = find_mover(clip, poses, references, options.free_space, options.mover, hint, looks)
    return balls, judge_motion(references, options.free_space, options.mover, options.weighing)


def _learn(painter: Painter, options: Options, rng: np.random.Generator) -> Appearance | None:
    """Learn the animal's looks from first masks of frames spread over the recording; None where it is never seen."""
    first = replace(painter, looks=learn_palette(painter))
    seen = np.array([frame for frame, ball in enumerate(painter.balls) if ball is not None and not ball.presumed])
    if not len(seen):
        return None
    chosen = seen[np.unique(np.linspace(0, len(seen) - 1, options.learning.examples).round().astype(int))]
    height_px = painter.options.height_px
    examples = [Example(working_picture(painter.clip, frame, height_px), first.working_mask(frame).labels) for frame in chosen.tolist()]
    network = learn(examples, options.learning, rng)
    return network if network is not None and _knows(network, examples[:: max(1, len(examples) // 12)]) else None


def _knows(network: Appearance, examples: list[Example], least: float = 0.6) -> bool:
    """Tell whether a network finds most of the animal that it was shown; one that has not learnt enough would only veto."""
    shown = [(network.log_odds(each.color)[each.labels == 255] > 0).mean() for each in examples if (each.labels == 255).any()]
    return bool(shown) and float(np.mean(shown)) > least


def _hidden(painter: Painter, frame: int, network: Appearance) -> Bool[np.ndarray, "height width"]:
    """Tell where the animal, by its looks and with a rim, hides the room: near where it was seen to move, if it was."""
    color = working_picture(painter.clip, frame, painter.options.height_px)
    like, ball = network.log_odds(color) > 0, painter.balls[frame]
    if ball is not None and not ball.presumed:
        rows, columns = rectangle(painter.clip, frame, painter.world_from_camera[frame], ball, color.shape[:2])
        beside = np.ones_like(like)
        beside[rows, columns] = False
        like &= ~beside
    return cv2.dilate(like.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
