"""Gather what the stages wrote about themselves: `qa.json`, its pictures, and the settings in the manifest."""

import base64
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.files import images
from pipeline.videos import Video
from stages.report.chapters import Chapter

LIGHTS = ("none", "ok", "warn", "fail")
_PICTURE_BYTES = 10_000_000
_SMALLEST_PX = 160
_BLUR_PX = 24
"""what lies within this distance becomes one colour"""
_STRIP = 2.4
"""width over height of a picture that is a strip"""


@dataclass(frozen=True)
class Picture:
    """One picture, ready to stand in a page."""

    source: str
    """data URI"""
    caption: str
    wide: bool
    """a strip that wants the page's whole width"""


@dataclass(frozen=True)
class Note:
    """What one artifact says about itself; per recording where there is one for each."""

    video: str | None
    about: str
    """the recording's file and role"""
    light: str
    good: str
    bad: str
    checks: list[dict[str, Any]]
    pictures: list[Picture]


@dataclass(frozen=True)
class Told:
    """A chapter with all its notes."""

    chapter: Chapter
    notes: list[Note]
    settings: dict[str, Any]

    @property
    def light(self) -> str:
        """The worst light of all notes."""
        return max((note.light for note in self.notes), key=LIGHTS.index, default="none")

    @property
    def worries(self) -> list[tuple[Note, dict[str, Any]]]:
        """Checks that are not fine, worst first."""
        found = [(note, check) for note in self.notes for check in note.checks if check["status"] in ("warn", "fail")]
        return sorted(found, key=lambda pair: -LIGHTS.index(pair[1]["status"]))

    @property
    def cover(self) -> Picture | None:
        """The first picture there is."""
        return next((picture for note in self.notes for picture in note.pictures), None)


def about(video: Video, safe: bool) -> str:
    """Say which recording it is and what it is for; names of files may tell of people, so not where the report is to be ``safe``."""
    role = f"{video.role}, {video.split}" if video.role == "session" else video.role
    return role if safe else f"{video.file}, {role}"


def told(
    chapter: Chapter, folders: Mapping[str | None, Path], abouts: Mapping[str, str], settings: Mapping[str, Any], safe: bool = False
) -> Told:
    """Read the notes of one chapter; `folders` are its artifacts by recording (None: one in all).

    With `safe` every picture that a person or the home can be in is blurred beyond recognition as a whole: where people
    stand in it is not known, finders of people miss some, and a room tells where somebody lives.
    """
    raw = {video: _read(folder) for video, folder in folders.items()}
    files = [folder / entry["file"] for folder, qa in zip(folders.values(), raw.values(), strict=True) for entry in qa["pictures"]]
    total = sum(file.stat().st_size for file in files)
    shrink = max(1.0, total / _PICTURE_BYTES) ** 0.5

    def blurred(file: str) -> bool:
        return safe and not any(fnmatch(Path(file).stem, name) for name in chapter.nobody_in)

    notes = [_note(video, abouts.get(video or "", ""), folders[video], qa, shrink, blurred) for video, qa in raw.items()]
    return Told(chapter, notes, dict(settings))


def _read(folder: Path) -> dict[str, Any]:
    path = folder / "qa.json"
    return json.loads(path.read_bytes()) if path.exists() else {"status": "none", "good": "", "bad": "", "checks": [], "pictures": []}


def _note(video: str | None, about: str, folder: Path, qa: dict[str, Any], shrink: float, blurred: Callable[[str], bool]) -> Note:
    pictures = [_picture(folder / entry["file"], entry["caption"], shrink, blurred(entry["file"])) for entry in qa["pictures"]]
    return Note(video, about, qa["status"], qa["good"], qa["bad"], qa["checks"], pictures)


def _picture(path: Path, caption: str, shrink: float, blurred: bool) -> Picture:
    """Embed a picture; where a page would grow too big to send, smaller."""
    color = images.read_color(path)
    kind, content = path.suffix[1:], path.read_bytes()
    if blurred:
        kind, content = "jpeg", images.encode_jpeg(_beyond_recognition(color), 80)
    elif shrink > 1:
        size = [max(_SMALLEST_PX, round(length / shrink)) for length in color.shape[1::-1]]
        kind, content = "jpeg", images.encode_jpeg(cv2.resize(color, size, interpolation=cv2.INTER_AREA), 85)
    source = f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
    return Picture(source, caption, color.shape[1] > _STRIP * color.shape[0])


def _beyond_recognition(color: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
    """Keep one colour per 24 pixels: layout and light stay, faces, pictures and writing go."""
    height, width, _ = color.shape
    few = cv2.resize(color, (max(1, width // _BLUR_PX), max(1, height // _BLUR_PX)), interpolation=cv2.INTER_AREA)
    return cv2.resize(few, (width, height), interpolation=cv2.INTER_LINEAR)
