"""Check recordings one after the other: the walk-through first, then each of the others against it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import InputError
from pipeline.recordings.formats import open_recording
from pipeline.videos import Role
from stages.check_captures import looking, movers, overlap, parallax, poses, telling
from stages.check_captures.overlap import Described
from stages.check_captures.problems import Problem, Seen, problems

MAX_DEPTH_M = 6.0


@dataclass(frozen=True)
class Verdict:
    """What was found of one recording."""

    name: str
    role: Role
    seen: Seen | None
    """None where it cannot be used"""
    problems: tuple[Problem, ...]
    text: str

    @property
    def usable(self) -> bool:
        """Tell whether a build goes on with it: a walk-through is mapped without depth, nothing else is."""
        return self.seen is not None and (self.seen.look.plan is not None or self.role == "walkthrough")


def check(files: Sequence[tuple[Path, Role]], samples: int, rng: np.random.Generator) -> Iterator[Verdict]:
    """Yield a verdict per recording as soon as it is known; walk-throughs come first."""
    room: list[Described] = []
    for path, role in sorted(files, key=lambda file: (file[1] != "walkthrough", file[0].name)):
        try:
            look = looking.look(open_recording(path), samples, max_depth_m=MAX_DEPTH_M)
        except InputError as error:
            found = (Problem(error.code, error.what, error.remedy),)
            yield Verdict(path.name, role, None, found, telling.refused(path, role, error))
            continue
        seen = _seen(look, role, room, rng)
        found = tuple(problems(seen, role))
        yield Verdict(path.name, role, seen, found, telling.told(path.name, role, seen, found))


def _seen(look: looking.Look, role: Role, room: list[Described], rng: np.random.Generator) -> Seen:
    """Measure what a role asks for; a walk-through's described frames are added to ``room``."""
    if look.plan is None:
        return Seen(look, parallax=parallax.parallax(look.shots) if role == "walkthrough" else None)
    drift_m = poses.drift_m(look.shots)
    if role == "walkthrough":
        room += overlap.describe(look.shots)
        return Seen(look, drift_m)
    # A turnaround may be filmed anywhere: it makes the animal's template, not the room's.
    placed = None if role == "turnaround" or not room else overlap.placed_share(room, overlap.describe(look.shots), rng)
    return Seen(look, drift_m, movers.moving(look.shots) if role == "session" else None, placed)
