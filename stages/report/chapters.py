"""The texts of the report, from `templates/words.toml`: chapters in flow order, remedies for checks."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any

WORDS: Mapping[str, Any] = tomllib.loads(
    resources.files("stages.report").joinpath("templates", "words.toml").read_text("utf-8")
)
"""Chapters, methods and remedies as written."""


@dataclass(frozen=True)
class Chapter:
    """One page of the report."""

    artifact: str
    title: str
    sentence: str
    """what this step does, in plain words"""
    per_video: bool = False
    nobody_in: tuple[str, ...] = ()
    """its pictures (names with *) that are drawn from numbers or show the animal alone: nobody, and no more
    of the home than its outline, can be in them"""


CHAPTERS = tuple(
    Chapter(**entry | {"nobody_in": tuple(entry.get("nobody_in", ()))}) for entry in WORDS["chapters"]
)


def remedy(artifact: str, check: str) -> str:
    """Return the remedy for a check that warns or fails; empty if there is none."""
    known = WORDS["remedies"].get(artifact, {})
    return next((words for begin, words in known.items() if check.lower().startswith(begin)), "")
