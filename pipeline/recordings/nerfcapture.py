"""NeRFCapture: the folder that its streaming scripts write (metric depth).

The zip the phone saves itself is refused.

Stream: `transforms.json` with `integer_depth_scale` (metres per unit), one colour and one 16-bit depth
picture per frame.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.core.errors import InputError
from pipeline.data import images
from pipeline.recordings.containers import Container, FolderContainer, ZipContainer, frame_number
from pipeline.recordings.conventions import OPENGL
from pipeline.recordings.recording import (  # fmt: skip
    MAX_PICTURE_BYTES,
    MAX_TEXT_BYTES,
    Y_UP,
    Recording,
    broken_metadata,
    intrinsics_from_coefficients,
    meters_from_png,
    no_frames,
    pose_from_matrix,
)

COEFFICIENTS = ("fl_x", "fl_y", "cx", "cy")
LEAST_REACH_M = 4.0
"""depth beyond what 16 bits reach comes back as near: what reaches less is refused, metres"""
LARGEST_UNIT = 65535
"""of 16 bits"""
ASSUMED_HZ = 10.0
"""of streams whose frames carry no times"""


def open_recording(path: Path) -> Recording:
    """Open a streamed NeRFCapture folder.

    Raises CAP-010 for the phone's own zip and for streams whose far depth is lost.
    """
    container: Container = FolderContainer(path) if path.is_dir() else ZipContainer(path)
    table = _table(container)
    scale = _meters_per_unit(table, container)
    frames = [
        frame
        for frame in _frames(table, container)
        if {frame["file_path"], frame["depth_path"]} <= container.names
    ]
    if not frames:
        raise no_frames(container.where, "no frame has colour and depth")
    timestamp_s, remarks = _times(frames, container.where)
    depth_size = meters_from_png(
        container.read(frames[0]["depth_path"], MAX_PICTURE_BYTES), None, container.where
    ).shape
    color_size = images.decode_color(
        container.read(frames[0]["file_path"], MAX_PICTURE_BYTES), container.where
    ).shape[:2]

    def depth(number: int) -> np.ndarray:
        name = frames[number]["depth_path"]
        return meters_from_png(
            container.read(name, MAX_PICTURE_BYTES), depth_size, f"{container.where}/{name}", 1 / scale
        )

    return Recording(
        where=container.where,
        kind="NeRFCapture stream",
        index=np.arange(len(frames)),
        timestamp_s=timestamp_s,
        intrinsics=intrinsics_from_coefficients(
            np.array([frame["coefficients"] for frame in frames]), container.where
        ),
        pose=pose_from_matrix(np.stack([frame["matrix"] for frame in frames])),
        color_size=color_size,
        depth_size=depth_size,
        read_color=lambda i: container.read(frames[i]["file_path"], MAX_PICTURE_BYTES),
        read_depth=depth,
        convention=OPENGL,
        up=Y_UP,
        remarks=remarks,
    )


def _meters_per_unit(table: dict[str, Any], container: Container) -> float:
    """Return the unit of the depth pictures, metres. Raises CAP-004 and CAP-010 where there is none."""
    if isinstance(container, ZipContainer) or "depth_integer_scale" in table:
        what = (
            "NeRFCapture's saved zip holds no metric depth"
            if "depth_integer_scale" in table
            else "a zip of transforms has no metric depth"
        )
        remedy = "stream from the app with its nerfcapture_dataset.py and give the folder that it writes"
        raise InputError("CAP-010", what, container.where, remedy)
    scale = table.get("integer_depth_scale")
    if not isinstance(scale, int | float) or not 0 < scale < 1:
        raise broken_metadata(container.where, "'integer_depth_scale' (metres per unit of depth) is missing")
    if LARGEST_UNIT * scale < LEAST_REACH_M:
        what = (
            f"depth beyond {LARGEST_UNIT * scale:.3g} m was written as if it were "
            "near: the stream's depth_scale is too small"
        )
        remedy = (
            "stream again with a depth_scale of 10; where nerfcapture_dataset.py "
            "fails with that option, change its default"
        )
        raise InputError("CAP-010", what, container.where, remedy)
    return scale


def _table(container: Container) -> dict[str, Any]:
    if "transforms.json" not in container.names:
        if isinstance(container, ZipContainer):
            what = "a zip that holds no NeRFCapture recording"
            raise InputError(
                "CAP-003", what, container.where, "unpack it, and give the folder that the app wrote"
            )
        raise InputError(
            "CAP-003",
            "not a NeRFCapture recording: it has no transforms.json",
            container.where,
            "give the streamed folder",
        )
    try:
        table = json.loads(container.read("transforms.json", MAX_TEXT_BYTES))
    except (ValueError, RecursionError) as error:
        raise broken_metadata(container.where, f"transforms.json is no JSON ({error})") from error
    if not isinstance(table, dict):
        raise broken_metadata(container.where, "transforms.json holds no table")
    return table


def _frames(table: dict[str, Any], container: Container) -> list[dict[str, Any]]:
    """Return the frames in the order of their numbers: the app appends them from parallel tasks."""
    found = []
    try:
        for frame in table["frames"]:
            matrix = np.array(frame["transform_matrix"], float).reshape(4, 4)
            coefficients = [float(frame.get(key, table.get(key))) for key in COEFFICIENTS]
            names = [
                _member(str(frame[key]).removeprefix("./"), container) for key in ("file_path", "depth_path")
            ]
            time_s = frame.get("timestamp")
            entry = dict(file_path=names[0], depth_path=names[1], matrix=matrix, coefficients=coefficients)
            found.append(entry | dict(time=None if time_s is None else float(time_s), order=_order(names[0])))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise broken_metadata(
            container.where, f"a frame of transforms.json cannot be read ({error!r})"
        ) from error
    return sorted(found, key=lambda entry: entry["order"])


def _member(name: str, container: Container) -> str:
    """Return the member that a frame names.

    The app author's script leaves out the ending of colour pictures.
    """
    return next((each for each in (name, f"{name}.png", f"{name}.jpg") if each in container.names), name)


def _order(name: str) -> tuple[int, str]:
    stem = Path(name).stem
    return (frame_number(stem) or 0, stem)


def _times(frames: list[dict[str, Any]], where: str) -> tuple[np.ndarray, tuple[str, ...]]:
    if any(frame["time"] is None for frame in frames):
        return np.arange(len(frames)) / ASSUMED_HZ, (
            f"the frames carry no times: {ASSUMED_HZ:g} per second are assumed",
        )
    timestamp_s = np.array([frame["time"] for frame in frames])
    if not (np.isfinite(timestamp_s).all() and (np.diff(timestamp_s) > 0).all()):
        raise broken_metadata(where, "the frames' times must increase with their numbers")
    return timestamp_s - timestamp_s[0], ()
