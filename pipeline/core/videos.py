"""The recordings of one agent with their role and split.

`plan` writes them to `build/<agent>/plan/videos.json`; stages read them with `read`. Standard library only.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from pipeline.core import config
from pipeline.core.errors import InputError

Role = Literal["walkthrough", "turnaround", "session", "heldout"]
Split = Literal["train", "test", "none"]
ROLES: tuple[Role, ...] = get_args(Role)
SPLITS: tuple[Split, ...] = get_args(Split)
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".3gp", ".webm")
"""suffixes of video files, lower case"""
PERSON = "person"
"""Name of the one who films, in simulations and environments, which no animal can have."""


@dataclass(frozen=True)
class Video:
    """One recording."""

    id: str
    """`v000`, `v001`, ...; never reused for another file."""
    file: str
    """Name in the capture folder, with any characters; not used in other paths."""
    role: Role
    split: Split
    """`train` or `test` for sessions, `none` for other roles."""
    sha256: str | None
    """Hash of the recording; None for the built-in capture, which has a manifest."""
    synchronized_with: str | None = None
    """Id of the session whose clock this one shares (held-out phone)."""
    offset_s: float = 0.0
    """Time in the other recording = time in this one + offset."""
    mapped: bool = False
    """A turnaround or session without depth: its cameras and depth come from the map of the walk-through."""
    animal: str | None = None
    """Name of the animal of a turnaround, in a home of several."""


def role_of_animal(
    video: Video | None, otherwise: Literal["turnaround", "session"]
) -> Literal["turnaround", "session"]:
    """Return whether a recording is the turnaround or a session; ``otherwise`` if it is unknown (None)."""
    if video is None:
        return otherwise
    return "turnaround" if video.role == "turnaround" else "session"


def read(path: Path) -> tuple[Video, ...]:
    """Read `videos.json`. Raises `InputError` ART-003 for anything else."""
    try:
        entries = json.loads(path.read_text())
        return tuple(config.from_table(Video, dict(entry), where=str(path)) for entry in entries)
    except (OSError, ValueError, TypeError, RecursionError, InputError) as error:
        remedy = "give build/<agent>/plan/videos.json"
        raise InputError("ART-003", "is no list of recordings", str(path), remedy) from error
