"""Masks of one recording from its pictures alone: the steps of this room in order."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, assert_never

import numpy as np

from pipeline.files.clips import Clip
from pipeline.space.straightening import Straightening
from stages.segment_agent import free_space
from stages.segment_agent import prompt as prompts
from stages.segment_agent.free_space import FreeSpace
from stages.segment_agent.movers import Hint, Mover
from stages.segment_agent.prompt import Prompt
from stages.segment_agent.refine import Refinement
from stages.segment_agent.segment import Mask, Weighing, find_mover, judge_motion, learn_palette, paint
from stages.segment_agent.trajectory import Trajectory, steady
from stages.segment_agent.turnaround import Turnaround, find_standing, meeting_point


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
    refinement: Refinement = field(default_factory=Refinement)
    """How evidence becomes a mask."""


def segment(
    clip: Clip, flow: Path, role: Literal["turnaround", "session"], hint: Prompt | None, options: Options, rng: np.random.Generator
) -> tuple[Iterator[Mask], Trajectory]:
    """Return one mask per frame, made as they are asked for, and the poses they rest on. ``flow`` is the recording's flow folder."""
    path = steady(clip, flow, options.straightening, rng)
    poses = path.world_from_camera
    place = None if hint is None else prompts.position(hint, clip, poses)
    match role:
        case "turnaround":
            balls, judge = find_standing(clip, poses, options.turnaround, meeting_point(poses) if place is None else place)
        case "session":
            references = free_space.gather(clip, poses, options.free_space)
            balls = find_mover(
                clip, poses, references, options.free_space, options.mover, None if place is None else Hint(hint.frame, place)
            )
            judge = judge_motion(references, options.free_space, options.mover, options.weighing)
        case _:
            assert_never(role)
    palette = learn_palette(clip, poses, balls, judge, options.refinement)
    return paint(clip, poses, balls, judge, palette, options.refinement), path
