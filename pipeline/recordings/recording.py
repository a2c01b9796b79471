"""What every format becomes: a `Recording` whose frames are known and whose pictures are read on demand.

Readers give poses and pictures as stored, with the convention that the format documents; checking and
turning them is the next files' work.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.core.errors import InputError
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from pipeline.recordings.conventions import OPENCV, Convention
from pipeline.recordings.depth_camera import DepthCamera

Y_UP = (0.0, 1.0, 0.0)
ORTHONORMAL = 0.02
"""largest entry by which a rotation, times itself transposed, may differ from the identity"""
Picture = bytes | UInt8[np.ndarray, "height width 3"]
"""an encoded JPEG or PNG, or decoded RGB"""


@dataclass(frozen=True)
class Recording:
    """A recording whose pictures are read on demand, all as stored (not yet upright)."""

    where: str
    kind: str
    """format, as people call it"""
    index: Int[np.ndarray, "frame"]
    """the app's number of each frame, in time order"""
    timestamp_s: Float[np.ndarray, "frame"]
    """increasing, on the recording's own clock, which starts at 0"""
    intrinsics: Float[np.ndarray, "frame 3 3"] | None
    """colour pixels; None where they are unknown (plain video)"""
    pose: Float[np.ndarray, "frame 7"] | None
    """four quaternion and three translation (metres) numbers as documented, NaN where lost; None without"""
    color_size: tuple[int, int]
    """(height, width) in pixels"""
    depth_size: tuple[int, int] | None
    """(height, width) in pixels; None where there is no depth"""
    read_color: Callable[[int], Picture | None]
    """picture of the app's frame number; None where the file is damaged there"""
    read_depth: Callable[[int], Float[np.ndarray, "height width"]]
    """metres as stored, of the app's frame number"""
    read_confidence: Callable[[int], UInt8[np.ndarray, "height width"] | None] | None = None
    """0 low, 1 medium, 2 high, and None for a frame that lacks it; None where the recording has none"""
    convention: Convention = OPENCV
    """what the format documents about its poses"""
    up: tuple[float, float, float] | None = None
    """direction that points up in the poses' world; None where the format does not document it"""
    quarter_turns: int = 0
    """clockwise, stored to upright, from the video rotation tag, used where `up` is None"""
    read_mesh: Callable[[], Mesh] | None = None
    """the app's own surface of the room, metres, in the poses' world; None where it has none"""
    depth_camera: DepthCamera | None = None
    """the depth camera where it is another one than the colour camera; None where depth is aligned"""
    remarks: tuple[str, ...] = ()
    """what had to be assumed or left out, one sentence each"""


def damaged(where: str, why: str) -> InputError:
    """Make the error for something that cannot be read to its end."""
    what = f"the recording is damaged or was not copied completely ({why})"
    return InputError("CAP-001", what, where, "export it from the phone again")


def broken_metadata(where: str, why: str) -> InputError:
    """Make the error for numbers beside the pictures that cannot be used, as after a change of format."""
    remedy = "export it from the phone again; if a newer app wrote it, report the app's version"
    return InputError("CAP-004", f"the recording's metadata cannot be used: {why}", where, remedy)


def no_depth(where: str, why: str) -> InputError:
    """Make the error for recordings without depth."""
    remedy = "record with a LiDAR phone, or add a depth picture per frame: see the README's table of formats"
    return InputError("CAP-006", f"no depth: {why}", where, remedy)


def no_frames(where: str, why: str) -> InputError:
    """Make the error for recordings of which no frame is whole."""
    return InputError("CAP-007", f"no usable frames: {why}", where, "export it from the phone again")


def wrong_depth(where: str, why: str) -> InputError:
    """Make the error for a depth picture of another size or kind than it must be."""
    return InputError("CAP-008", f"a depth picture is wrong: {why}", where, "export it from the phone again")


def refuse_other_size(shape: tuple[int, ...], size: tuple[int, int] | None, where: str) -> None:
    """Raise CAP-008 for a depth picture of another (height, width) than ``size``, where one is expected."""
    if size is not None and shape != size:
        raise wrong_depth(where, f"{shape[1]} x {shape[0]} instead of {size[1]} x {size[0]}")


def pose_from_matrix(world_from_camera: Float[np.ndarray, "frame 4 4"]) -> Float[np.ndarray, "frame 7"]:
    """Turn matrices into stored poses (quaternion xyzw, translation); NaN where one is no rigid motion."""
    pose = np.full((len(world_from_camera), 7), np.nan)
    rotation = world_from_camera[:, :3, :3]
    with np.errstate(all="ignore"):
        off = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max((1, 2))
        good = (
            np.isfinite(world_from_camera).all((1, 2))
            & (off < ORTHONORMAL)
            & (np.linalg.det(np.nan_to_num(rotation)) > 0)
        )
    if good.any():
        pose[good, :4] = np.roll(rigid.quaternion_from_rotation(rotation[good]), -1, axis=1)
        pose[good, 4:] = world_from_camera[good, :3, 3]
    return pose


def intrinsics_from_coefficients(
    coefficients: Float[np.ndarray, "frame 4"], where: str
) -> Float[np.ndarray, "frame 3 3"]:
    """Turn (fx, fy, cx, cy) per frame into matrices; raises CAP-004 for impossible values."""
    if not np.isfinite(coefficients).all() or np.any(coefficients[:, :2] <= 0):
        raise broken_metadata(where, "the focal length must be positive")
    intrinsics = np.tile(np.eye(3), (len(coefficients), 1, 1))
    intrinsics[:, [0, 1, 0, 1], [0, 1, 2, 2]] = coefficients
    return intrinsics
