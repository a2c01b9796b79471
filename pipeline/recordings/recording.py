"""The common interface of all formats: a `Recording` whose pictures are read on demand.

Readers return poses and pictures as stored, with the convention that the format documents; `extraction`
checks and rotates them.
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
"""maximum deviation of R R^T from the identity, per entry"""
Picture = bytes | UInt8[np.ndarray, "height width 3"]
"""an encoded JPEG or PNG, or decoded RGB"""


@dataclass(frozen=True)
class Recording:
    """A recording whose pictures are read on demand, all as stored (not yet upright)."""

    where: str
    kind: str
    """name of the format"""
    index: Int[np.ndarray, "frame"]
    """the app's frame numbers, in time order"""
    timestamp_s: Float[np.ndarray, "frame"]
    """increasing, from 0 on the recording's own clock"""
    intrinsics: Float[np.ndarray, "frame 3 3"] | None
    """color pixels; None if unknown (plain video)"""
    pose: Float[np.ndarray, "frame 7"] | None
    """quaternion and translation (meters) in the documented convention, NaN where lost; None without"""
    color_size: tuple[int, int]
    """(height, width) in pixels"""
    depth_size: tuple[int, int] | None
    """(height, width) in pixels; None without depth"""
    read_color: Callable[[int], Picture | None]
    """picture of a frame number; None if it is damaged"""
    read_depth: Callable[[int], Float[np.ndarray, "height width"]]
    """depth of a frame number, meters, as stored"""
    read_confidence: Callable[[int], UInt8[np.ndarray, "height width"] | None] | None = None
    """0 low, 1 medium, 2 high, or None for a frame without; None if the recording has none"""
    convention: Convention = OPENCV
    """documented convention of the poses"""
    up: tuple[float, float, float] | None = None
    """up direction in the poses' world; None if the format does not document it"""
    quarter_turns: int = 0
    """clockwise, stored to upright, from the video's rotation tag; used if `up` is None"""
    read_mesh: Callable[[], Mesh] | None = None
    """the app's own mesh of the room, meters, in the poses' world; None without"""
    depth_camera: DepthCamera | None = None
    """the depth camera; None if depth is registered to the color camera"""
    remarks: tuple[str, ...] = ()
    """assumptions and omissions, one sentence each"""
    listed: int = 0
    """frames that its files list, of which ``index`` holds the complete ones; 0 if not known"""

    @property
    def incomplete(self) -> float:
        """Share (0..1) of the listed frames whose picture, depth or metadata are missing."""
        return max(0, self.listed - len(self.index)) / max(self.listed, 1)


def damaged(where: str, why: str) -> InputError:
    """Return the error for a damaged or truncated file."""
    what = f"the recording is damaged or was not copied completely ({why})"
    return InputError("CAP-001", what, where, "export it from the phone again")


def broken_metadata(where: str, why: str) -> InputError:
    """Return the error for invalid metadata, as after a change of the format."""
    remedy = "export it from the phone again; if a newer app wrote it, report the app's version"
    return InputError("CAP-004", f"the recording's metadata cannot be used: {why}", where, remedy)


def no_depth(where: str, why: str) -> InputError:
    """Return the error for recordings without depth."""
    remedy = "record with a LiDAR phone, or add a depth picture per frame: see the README's table of formats"
    return InputError("CAP-006", f"no depth: {why}", where, remedy)


def no_frames(where: str, why: str) -> InputError:
    """Return the error for recordings without a complete frame."""
    return InputError("CAP-007", f"no usable frames: {why}", where, "export it from the phone again")


def wrong_depth(where: str, why: str) -> InputError:
    """Return the error for a depth picture of a wrong size or type."""
    return InputError("CAP-008", f"a depth picture is wrong: {why}", where, "export it from the phone again")


def refuse_other_size(shape: tuple[int, ...], size: tuple[int, int] | None, where: str) -> None:
    """Raise CAP-008 for a depth picture whose (height, width) is not ``size``, if given."""
    if size is not None and shape != size:
        raise wrong_depth(where, f"{shape[1]} x {shape[0]} instead of {size[1]} x {size[0]}")


def pose_from_matrix(world_from_camera: Float[np.ndarray, "frame 4 4"]) -> Float[np.ndarray, "frame 7"]:
    """Convert matrices to poses (quaternion xyzw, translation); NaN where one is not a rigid motion."""
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
    """Convert (fx, fy, cx, cy) per frame to matrices. Raises CAP-004 for impossible values."""
    if not np.isfinite(coefficients).all() or np.any(coefficients[:, :2] <= 0):
        raise broken_metadata(where, "the focal length must be positive")
    intrinsics = np.tile(np.eye(3), (len(coefficients), 1, 1))
    intrinsics[:, [0, 1, 0, 1], [0, 1, 2, 2]] = coefficients
    return intrinsics
