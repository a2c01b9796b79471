"""What the user says about a recording's depth, in `<recording>.depth.toml` beside it."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.core import config
from pipeline.geometry import cameras
from pipeline.recordings import errors, text_files
from pipeline.recordings.recording import DepthCamera, Recording, intrinsics_from_coefficients

COEFFICIENTS, MATRIX = 4, (4, 4)
LONGEST_DELAY_S = 2.0


@dataclass(frozen=True)
class GivenCalibration:
    """What is given is used, and the rest estimated."""

    registered: bool = False
    """The depth camera is as the recording states, by default the color camera: keep it."""
    depth_intrinsics: tuple[float, ...] = ()
    """fx, fy, cx, cy of the depth camera, pixels of depth as stored; empty: those of the color camera."""
    depth_from_color: tuple[float, ...] = ()
    """Its 4 x 4 matrix row by row, meters; empty: the color camera's pose."""
    delay_s: float | None = None
    """Depth shows what pictures showed this long before, seconds."""


NOTHING = GivenCalibration()


def read(path: Path | None) -> GivenCalibration:
    """Read the file, if there is one. Raises InputError REC-001..003, CAP-004 for impossible values."""
    if path is None:
        return NOTHING
    given, where = config.from_table(GivenCalibration, config.read_table(path), where=str(path)), str(path)
    counts = len(given.depth_intrinsics), len(given.depth_from_color)
    if counts[0] not in (0, COEFFICIENTS) or counts[1] not in (0, np.prod(MATRIX)):
        raise errors.broken_metadata(where, "depth_intrinsics has 4 numbers, depth_from_color 16")
    if given.registered and any(counts):
        raise errors.broken_metadata(where, "depth is either registered or has a camera of its own")
    if given.delay_s is not None and not abs(given.delay_s) < LONGEST_DELAY_S:
        raise errors.broken_metadata(where, f"delay_s is not within {LONGEST_DELAY_S:g} s")
    return given


def sidecar_of(recording: Path) -> GivenCalibration:
    """Read the file beside a recording, if there is one. Raises what `read` raises."""
    file = recording.with_name(f"{recording.name}.depth.toml")
    return read(file if file.is_file() else None)


def described(recording: Recording, given: GivenCalibration) -> Recording:
    """Return a recording with the depth camera that is given, if any. Raises CAP-004."""
    size, where = recording.depth_size, recording.where
    separate = given.depth_intrinsics or given.depth_from_color
    if recording.intrinsics is None or size is None or not separate:
        return recording
    lens = cameras.scale_intrinsics(recording.intrinsics[0], recording.color_size, size)
    if given.depth_intrinsics:
        lens = intrinsics_from_coefficients(np.array([given.depth_intrinsics]), where)[0]
    matrix = np.array(given.depth_from_color or tuple(np.eye(4).ravel())).reshape(MATRIX)
    camera = text_files.possible(DepthCamera(lens, matrix), where)
    remark = text_files.depth_camera_remark(camera, recording.intrinsics[0])
    return replace(recording, depth_camera=camera, remarks=(*recording.remarks, remark))
