"""The known formats: how each is recognized and which module reads it.

A new format is a module with `open_recording` and a line here. Standard library only until a recording is
opened, since the planner uses `format_of`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.core.errors import InputError
from pipeline.core.videos import VIDEO_SUFFIXES, Video

if TYPE_CHECKING:
    from pipeline.recordings.recording import Recording

UNDERSTOOD = (
    "Record3D .r3d or EXR + JPG folder, Stray Scanner, Polycam raw data, NeRFCapture stream, TUM or 7-Scenes "
    "folder, a folder with a video, depth/ and intrinsics.txt, a video alone"
)

MAX_SCALE_SOURCES = 3
"""maximum number of sessions read for scale; each takes half a minute"""


@dataclass(frozen=True)
class Format:
    """One format of recordings."""

    name: str
    fits: Callable[[Path], bool]
    """whether a path has this format, judged by names only"""
    reader: str
    """module of this package that reads it"""
    has_depth: bool = True


def _holds(*names: str) -> Callable[[Path], bool]:
    return lambda path: path.is_dir() and all((path / name).exists() for name in names)


def _is_file(*suffixes: str) -> Callable[[Path], bool]:
    return lambda path: path.is_file() and path.suffix.lower() in suffixes


def _holds_movie(path: Path) -> bool:
    return (path / "depth").is_dir() and any(each.suffix.lower() in VIDEO_SUFFIXES for each in path.iterdir())


FORMATS: tuple[Format, ...] = (
    Format("Record3D .r3d", _is_file(".r3d"), "record3d"),
    Format(
        "Record3D EXR + JPG",
        lambda path: _holds("metadata.json")(path) or _holds("EXR_RGBD/metadata.json")(path),
        "record3d",
    ),
    Format("Stray Scanner", _holds("rgb.mp4", "odometry.csv"), "stray_scanner"),
    Format("Polycam raw data", _holds("keyframes"), "polycam"),
    Format(
        "NeRFCapture", lambda path: _is_file(".zip")(path) or _holds("transforms.json")(path), "nerfcapture"
    ),
    Format("TUM RGB-D", _holds("rgb.txt", "depth.txt"), "tum"),
    Format("7-Scenes RGB-D", lambda path: any(path.glob("frame-*.color.*")), "seven_scenes"),
    Format("video and depth", _holds_movie, "plain_video"),
    Format("video alone", _is_file(*VIDEO_SUFFIXES), "plain_video", has_depth=False),
)


def format_of(path: Path) -> Format | None:
    """Return the format of a path, judged by names, or None."""
    return next((each for each in FORMATS if each.fits(path)), None)


def open_recording(path: Path) -> Recording:
    """Open a recording of any format without reading pictures. Raises CAP-003, and errors of its reader."""
    if not path.exists():
        raise InputError("CAP-003", "there is no such recording", str(path), f"give one of: {UNDERSTOOD}")
    found = format_of(path)
    if found is None:
        raise InputError("CAP-003", "not a recording of a known format", str(path), f"known: {UNDERSTOOD}")
    from pipeline.recordings import (
        nerfcapture,
        plain_video,
        polycam,
        record3d,
        seven_scenes,
        stray_scanner,
        tum,
    )

    modules = (nerfcapture, plain_video, polycam, record3d, seven_scenes, stray_scanner, tum)
    return next(each for each in modules if each.__name__.endswith(f".{found.reader}")).open_recording(path)


def scale_sources(folder: Path, video: Video, videos: Iterable[Video]) -> list[Video]:
    """Return the training sessions in ``folder`` whose depth scales a walk-through without depth."""
    if video.role != "walkthrough" or has_depth(folder / video.file):
        return []
    sessions = (other for other in videos if other.role == "session" and other.split == "train")
    return [other for other in sessions if has_depth(folder / other.file)][:MAX_SCALE_SOURCES]


def has_depth(path: Path) -> bool:
    """Return whether a recording has depth, judged by names only."""
    found = format_of(path)
    return found is not None and found.has_depth
