"""Gather what the stages wrote about themselves: `qa.json`, its pictures, and what the manifest records.

`read_chapter` reads one, `with_verdicts` adds to each what it stands on.
"""

import base64
import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.core.videos import Video
from pipeline.data import images

WORDS: Mapping[str, Any] = tomllib.loads(
    resources.files("stages.report").joinpath("templates", "words.toml").read_text("utf-8")
)
"""The texts of the report: chapters in flow order, methods, remedies for checks."""
LIGHTS = ("none", "ok", "warn", "fail")
PAGE_OF = {"estimated_frames": "frames", "home_masks": "identities"}
"""where inputs without a page of their own are judged: theirs, or that of what they are made from"""
_PICTURE_BYTES = 10_000_000
_SMALLEST_PX = 160
_JPEG_QUALITY, _BLURRED_JPEG_QUALITY = 85, 80
_BLUR_PX = 24
"""size of blocks that become one color"""
_STRIP = 2.4
"""minimum aspect ratio of a strip"""


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


@dataclass(frozen=True)
class EmbeddedPicture:
    """One picture, ready to embed in a page."""

    source: str
    """data URI"""
    caption: str
    wide: bool
    """a strip that needs the full width of the page"""


@dataclass(frozen=True)
class RecordingLabel:
    """Label of a recording."""

    name: str = ""
    """its file name; its id if names may reveal people"""
    role: str = ""


@dataclass(frozen=True)
class Note:
    """What one artifact reports about itself; per recording where there is one for each."""

    video: str | None
    label: RecordingLabel
    light: str
    good: str
    bad: str
    checks: list[dict[str, Any]]
    pictures: list[EmbeddedPicture]


@dataclass(frozen=True)
class ChapterReport:
    """A chapter with all its notes and its verdict."""

    chapter: Chapter
    notes: list[Note]
    settings: dict[str, Any]
    depends_on: frozenset[str] = frozenset()
    """artifacts that it depends on"""
    bars: str = "ok"
    """the worst status of the thresholds on its metrics"""
    causes: tuple[Chapter, ...] = ()
    """direct and indirect dependencies whose own status is worse"""
    inherited: str = "ok"
    """the worst status of these"""

    @property
    def own_status(self) -> str:
        """The worst status of all notes and thresholds."""
        found = [note.light for note in self.notes] + ([self.bars] if self.bars != "ok" else [])
        return max(found, key=LIGHTS.index, default="none")

    @property
    def light(self) -> str:
        """The verdict: the worst of its own status and that of its dependencies."""
        return max(self.own_status, self.inherited, key=LIGHTS.index) if self.causes else self.own_status

    @property
    def warnings(self) -> list[tuple[Note, dict[str, Any]]]:
        """Checks that are not ok, worst first."""
        bad = ("warn", "fail")
        found = [(note, check) for note in self.notes for check in note.checks if check["status"] in bad]
        return sorted(found, key=lambda pair: -LIGHTS.index(pair[1]["status"]))

    @property
    def cover(self) -> EmbeddedPicture | None:
        """The first picture, if any."""
        return next((picture for note in self.notes for picture in note.pictures), None)


def label(video: Video, safe: bool) -> RecordingLabel:
    """Return the label of a recording; its file name only if the report is not ``safe``."""
    role = f"{video.role}, {video.split}" if video.role == "session" else video.role
    return RecordingLabel(video.id if safe else video.file, role)


def read_chapter(
    chapter: Chapter,
    folders: Mapping[str | None, Path],
    labels: Mapping[str, RecordingLabel],
    safe: bool = False,
) -> ChapterReport:
    """Read the notes of one chapter; `folders` are its artifacts by recording (None: one in all).

    With `safe` every picture that a person or the home can be in is blurred beyond recognition as a whole:
    where people stand in it is not known, finders of people miss some, and a room shows where somebody lives.
    """
    raw = {video: _read(folder) for video, folder in folders.items()}
    manifests = [manifest for folder in folders.values() if (manifest := read_manifest(folder))]
    files = [folders[video] / entry["file"] for video, qa in raw.items() for entry in qa["pictures"]]
    total = sum(file.stat().st_size for file in files)
    shrink = max(1.0, total / _PICTURE_BYTES) ** 0.5

    def named(caption: str) -> str:
        return re.sub(r"\bv\d+\b", lambda v: labels.get(v[0], RecordingLabel()).name or v[0], caption)

    def blurred(file: str) -> bool:
        return safe and not any(fnmatch(Path(file).stem, name) for name in chapter.nobody_in)

    notes = []
    for video, qa in raw.items():
        pictures = [
            _picture(folders[video] / entry["file"], named(entry["caption"]), shrink, blurred(entry["file"]))
            for entry in qa["pictures"]
        ]
        label = labels.get(video or "", RecordingLabel())
        notes.append(Note(video, label, qa["status"], qa["good"], qa["bad"], qa["checks"], pictures))
    read: set[str] = {name.partition("/")[0] for manifest in manifests for name in manifest["inputs"]}
    depends_on = frozenset(PAGE_OF.get(name, name) for name in read)
    return ChapterReport(chapter, notes, dict(manifests[0]["config"]) if manifests else {}, depends_on)


def with_verdicts(chapters: Sequence[ChapterReport], bars: Mapping[str, str]) -> list[ChapterReport]:
    """Add to chapters, in flow order, the status of their thresholds and of their dependencies."""
    found: dict[str, ChapterReport] = {}
    reached: dict[str, frozenset[str]] = {}
    for each in chapters:
        name, mine = each.chapter.artifact, replace(each, bars=bars.get(each.chapter.artifact, "ok"))
        direct = [each for each in mine.depends_on if each in found]
        reached[name] = frozenset(direct).union(*(reached[below] for below in direct))
        own = LIGHTS.index(mine.own_status)
        worse = [found[below] for below in found if below in reached[name]]
        worse = [below for below in worse if LIGHTS.index(below.own_status) > max(own, LIGHTS.index("ok"))]
        inherited = max((below.own_status for below in worse), key=LIGHTS.index, default="ok")
        causes = tuple(below.chapter for below in worse if below.own_status == inherited)
        found[name] = replace(mine, causes=causes, inherited=inherited)
    return list(found.values())


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """Return the manifest of a finished artifact; None for a plain folder."""
    path = folder / "manifest.json"
    return json.loads(path.read_bytes()) if path.exists() else None


def _read(folder: Path) -> dict[str, Any]:
    path = folder / "qa.json"
    if path.exists():
        return json.loads(path.read_bytes())
    return {"status": "none", "good": "", "bad": "", "checks": [], "pictures": []}


def _picture(path: Path, caption: str, shrink: float, blurred: bool) -> EmbeddedPicture:
    """Embed a picture, downscaled if the page would get too large to send."""
    color = images.read_color(path)
    kind, content = path.suffix[1:], path.read_bytes()
    if blurred:
        kind, content = "jpeg", images.encode_jpeg(_beyond_recognition(color), _BLURRED_JPEG_QUALITY)
    elif shrink > 1:
        size = [max(_SMALLEST_PX, round(length / shrink)) for length in color.shape[1::-1]]
        small = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
        kind, content = "jpeg", images.encode_jpeg(small, _JPEG_QUALITY)
    source = f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
    return EmbeddedPicture(source, caption, color.shape[1] > _STRIP * color.shape[0])


def _beyond_recognition(color: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
    """Pixelate to blocks of 24 pixels: layout and light remain, faces, pictures and text do not."""
    height, width, _ = color.shape
    size = max(1, width // _BLUR_PX), max(1, height // _BLUR_PX)
    few = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    return cv2.resize(few, (width, height), interpolation=cv2.INTER_LINEAR)
