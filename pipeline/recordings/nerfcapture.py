"""NeRFCapture: the folder that its streaming scripts write; the zip the phone saves has no metric depth.

Stream: `transforms.json` with `integer_depth_scale` (meters per unit), a color and a 16-bit depth picture
per frame.
"""

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.core.errors import InputError
from pipeline.recordings import errors, text_files
from pipeline.recordings.containers import Container, FolderContainer, ZipContainer, frame_number
from pipeline.recordings.conventions import OPENGL
from pipeline.recordings.recording import Y_UP, Recording, intrinsics_from_coefficients, pose_from_matrix

COEFFICIENTS = ("fl_x", "fl_y", "cx", "cy")
MIN_REACH_M = 4.0
"""minimum range of 16-bit depth, meters: beyond its range depth wraps around"""
LARGEST_UNIT = 65535
"""maximum value of 16-bit depth"""
ASSUMED_HZ = 10.0
"""frame rate of streams without timestamps"""


def open_recording(path: Path) -> Recording:
    """Open a streamed folder. Raises CAP-010 for the phone's own zip and streams whose depth wraps around."""
    container: Container = FolderContainer(path) if path.is_dir() else ZipContainer(path)
    table = _table(container)
    scale = _meters_per_unit(table, container)
    listed = _frames(table, container)
    frames = [frame for frame in listed if {frame["file_path"], frame["depth_path"]} <= container.names]
    if not frames:
        raise errors.no_frames(container.where, "no frame has color and depth")
    frames, timestamp_s, remarks = _timed(frames, container.where)
    depth_size = container.meters(frames[0]["depth_path"]).shape
    coefficients = np.array([frame["coefficients"] for frame in frames])
    return Recording(
        where=container.where,
        kind="NeRFCapture stream",
        index=np.arange(len(frames)),
        timestamp_s=timestamp_s,
        intrinsics=intrinsics_from_coefficients(coefficients, container.where),
        pose=pose_from_matrix(np.stack([frame["matrix"] for frame in frames])),
        color_size=container.color(frames[0]["file_path"]).shape[:2],
        depth_size=depth_size,
        read_color=lambda i: container.read(frames[i]["file_path"]),
        read_depth=lambda i: container.meters(frames[i]["depth_path"], depth_size, 1 / scale),
        convention=OPENGL,
        up=Y_UP,
        remarks=remarks,
        listed=len(listed),
    )


def _meters_per_unit(table: dict[str, Any], container: Container) -> float:
    """Return the unit of the depth pictures, meters. Raises CAP-004 and CAP-010 if there is none."""
    if isinstance(container, ZipContainer) or "depth_integer_scale" in table:
        what = "a zip of transforms, as NeRFCapture saves it, holds no metric depth"
        remedy = "stream from the app with its nerfcapture_dataset.py and give the folder that it writes"
        raise InputError("CAP-010", what, container.where, remedy)
    scale = table.get("integer_depth_scale")
    if not isinstance(scale, int | float) or not 0 < scale < 1:
        why = "'integer_depth_scale' (meters per unit of depth) is missing"
        raise errors.broken_metadata(container.where, why)
    if LARGEST_UNIT * scale < MIN_REACH_M:
        what = f"depth beyond {LARGEST_UNIT * scale:.3g} m was written as if it were near"
        remedy = "stream again with a depth_scale of 10, if need be as the default of nerfcapture_dataset.py"
        raise InputError("CAP-010", what, container.where, remedy)
    return scale


def _table(container: Container) -> dict[str, Any]:
    if "transforms.json" in container.names:
        return container.table("transforms.json")
    what, remedy = "not a NeRFCapture recording: it has no transforms.json", "give the streamed folder"
    if isinstance(container, ZipContainer):
        what = "a zip that holds no NeRFCapture recording"
        unpack = "unpack it, and give the folder that the app wrote"
        remedy = "rename it to .r3d" if {"metadata", "rgbd/0.jpg"} <= container.names else unpack
    raise InputError("CAP-003", what, container.where, remedy)


def _frames(table: dict[str, Any], container: Container) -> list[dict[str, Any]]:
    """Return the frames sorted by number: the app appends them from parallel tasks."""
    found = []
    try:
        for frame in table["frames"]:
            matrix = np.array(frame["transform_matrix"], float).reshape(4, 4)
            coefficients = [float(frame.get(key, table.get(key))) for key in COEFFICIENTS]
            color, depth = (_member(str(frame[key]), container) for key in ("file_path", "depth_path"))
            time_s = frame.get("timestamp")
            entry = dict(file_path=color, depth_path=depth, matrix=matrix, coefficients=coefficients)
            found.append(entry | dict(time=None if time_s is None else float(time_s)))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        why = f"a frame of transforms.json cannot be read ({error!r})"
        raise errors.broken_metadata(container.where, why) from error
    stems = (Path(entry["file_path"]).stem for entry in found)
    order = sorted((frame_number(stem) or 0, stem, row) for row, stem in enumerate(stems))
    return [found[row] for _, _, row in order]


def _member(name: str, container: Container) -> str:
    """Return the member that a frame names; the app's script omits the suffix of color pictures."""
    name = name.removeprefix("./")
    return next((each for each in (name, f"{name}.png", f"{name}.jpg") if each in container.names), name)


def _timed(frames: list[dict], where: str) -> tuple[list[dict], np.ndarray, tuple[str, ...]]:
    """Return the frames whose times increase, these times from 0, and remarks."""
    if any(frame["time"] is None for frame in frames):
        remark = f"the frames carry no times: {ASSUMED_HZ:g} per second are assumed"
        return frames, np.arange(len(frames)) / ASSUMED_HZ, (remark,)
    timestamp_s = np.array([frame["time"] for frame in frames])
    timed = np.flatnonzero(text_files.increasing(timestamp_s, where))
    return [frames[row] for row in timed], timestamp_s[timed] - timestamp_s[timed[0]], ()
