"""The formats that are understood: how each is recognised and which file of this room reads it.

A new format is one file with `open_recording` and one line here. Standard library only until a recording
is opened: the planner looks at the disk with `format_of`.
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
    "Record3D .r3d or EXR + JPG folder, Stray Scanner, Polycam raw data, "
    "NeRFCapture stream, TUM or 7-Scenes folder, "
    "a folder with a video, depth/ and intrinsics.txt, a video alone for the walk-through"
)

MOST_SCALE_SOURCES = 3
"""sessions that are read for scale; each costs half a minute"""


@dataclass(frozen=True)
class Format:
    """One kind of recording."""

    name: str
    fits: Callable[[Path], bool]
    """whether a path is one, by names alone"""
    open: Callable[[Path], Recording]
    """reads what the pictures' frames need, no pictures; raises InputError"""
    has_depth: bool = True


def _record3d(path: Path) -> Recording:
    from pipeline.recordings import record3d

    return record3d.open_recording(path)


def _stray(path: Path) -> Recording:
    from pipeline.recordings import stray_scanner

    return stray_scanner.open_recording(path)


def _polycam(path: Path) -> Recording:
    from pipeline.recordings import polycam

    return polycam.open_recording(path)


def _nerfcapture(path: Path) -> Recording:
    from pipeline.recordings import nerfcapture

    return nerfcapture.open_recording(path)


def _tum(path: Path) -> Recording:
    from pipeline.recordings import tum

    return tum.open_recording(path)


def _seven_scenes(path: Path) -> Recording:
    from pipeline.recordings import seven_scenes

    return seven_scenes.open_recording(path)


def _plain_video(path: Path) -> Recording:
    from pipeline.recordings import plain_video

    return plain_video.open_recording(path)


def _holds(*names: str) -> Callable[[Path], bool]:
    return lambda path: path.is_dir() and all((path / name).exists() for name in names)


def _is_file(*suffixes: str) -> Callable[[Path], bool]:
    return lambda path: path.is_file() and path.suffix.lower() in suffixes


def _holds_movie(path: Path) -> bool:
    return (
        path.is_dir()
        and (path / "depth").is_dir()
        and any(each.suffix.lower() in VIDEO_SUFFIXES for each in path.iterdir())
    )


def _holds_seven_scenes(path: Path) -> bool:
    return path.is_dir() and next(path.glob("frame-*.color.*"), None) is not None


FORMATS: tuple[Format, ...] = (
    Format("Record3D .r3d", _is_file(".r3d"), _record3d),
    Format(
        "Record3D EXR + JPG",
        lambda path: _holds("metadata.json")(path) or _holds("EXR_RGBD/metadata.json")(path),
        _record3d,
    ),
    Format("Stray Scanner", _holds("rgb.mp4", "odometry.csv"), _stray),
    Format("Polycam raw data", _holds("keyframes"), _polycam),
    Format(
        "NeRFCapture", lambda path: _is_file(".zip")(path) or _holds("transforms.json")(path), _nerfcapture
    ),
    Format("TUM RGB-D", _holds("rgb.txt", "depth.txt"), _tum),
    Format("7-Scenes RGB-D", _holds_seven_scenes, _seven_scenes),
    Format("video and depth", _holds_movie, _plain_video),
    Format("video alone", _is_file(*VIDEO_SUFFIXES), _plain_video, has_depth=False),
)


def format_of(path: Path) -> Format | None:
    """Return the format that a path's names fit, or None."""
    return next((each for each in FORMATS if each.fits(path)), None)


def open_recording(path: Path) -> Recording:
    """Open a recording of any format; raises CAP-003 when it is none, and what its reader raises."""
    if not path.exists():
        raise InputError("CAP-003", "there is no such recording", str(path), f"give one of: {UNDERSTOOD}")
    found = format_of(path)
    if found is None:
        raise InputError("CAP-003", "not a recording of a known format", str(path), f"known: {UNDERSTOOD}")
    return found.open(path)


def scale_sources(folder: Path, video: Video, videos: Iterable[Video]) -> list[Video]:
    """Return the recordings in ``folder`` whose depth may supply metric scale to ``video``.

    For a walk-through without depth these are some training sessions with depth; for any other none.
    """
    if video.role != "walkthrough" or has_depth(folder / video.file):
        return []
    sessions = (other for other in videos if other.role == "session" and other.split == "train")
    return [other for other in sessions if has_depth(folder / other.file)][:MOST_SCALE_SOURCES]


def has_depth(path: Path) -> bool:
    """Tell, by its names alone, whether a recording has depth."""
    found = format_of(path)
    return found is not None and found.has_depth
