"""The common interface of all formats: a `Recording` whose pictures are read on demand.

Readers return poses and pictures as stored, with the convention that the format documents; `extraction`
checks and rotates them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import Mesh
from pipeline.recordings import errors
from pipeline.recordings.conventions import OPENCV, Convention

Y_UP = (0.0, 1.0, 0.0)
ORTHONORMAL = 0.02
"""maximum deviation of R R^T from the identity, per entry"""
Picture = bytes | UInt8[np.ndarray, "height width 3"]
"""an encoded JPEG or PNG, or decoded RGB"""
NEAREST_M = 0.05
"""minimum depth in the color camera, meters"""


@dataclass(frozen=True)
class DepthCamera:
    """Intrinsics and extrinsics of a depth camera; both cameras have OpenCV axes."""

    intrinsics: Float[np.ndarray, "3 3"]
    """pixels of the depth picture as stored"""
    depth_from_color: Float[np.ndarray, "4 4"]
    """rigid, meters"""


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
    moved: Callable[[int, np.ndarray], np.ndarray] | None = None
    """moves a frame's depth or confidence, as the color camera sees it, to the time of its picture"""
    remarks: tuple[str, ...] = ()
    """assumptions and omissions, one sentence each"""
    listed: int = 0
    """frames that its files list, of which ``index`` holds the complete ones; 0 if not known"""

    @property
    def incomplete(self) -> float:
        """Share (0..1) of the listed frames whose picture, depth or metadata are missing."""
        return max(0, self.listed - len(self.index)) / max(self.listed, 1)

    def reprojected(self, number: int, depth: Float[np.ndarray, "_ _"]) -> Float[np.ndarray, "height width"]:
        """Return a frame's depth, meters, 0 = unknown, as the color camera sees it (see `reproject`)."""
        if self.depth_camera is None:
            return depth
        assert self.intrinsics is not None, self.where
        row = int(np.searchsorted(self.index, number))
        return reproject(depth, self.depth_camera, self.intrinsics[row], self.color_size)


def pose_from_matrix(world_from_camera: Float[np.ndarray, "frame 4 4"]) -> Float[np.ndarray, "frame 7"]:
    """Convert matrices to poses (quaternion xyzw, translation); NaN where one is not a rigid motion."""
    pose = np.full((len(world_from_camera), 7), np.nan)
    rotation = world_from_camera[:, :3, :3]
    with np.errstate(all="ignore"):
        off = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max((1, 2))
        rigid_motion = (off < ORTHONORMAL) & (np.linalg.det(np.nan_to_num(rotation)) > 0)
        good = np.isfinite(world_from_camera).all((1, 2)) & rigid_motion
    if good.any():
        pose[good, :4] = np.roll(rigid.quaternion_from_rotation(rotation[good]), -1, axis=1)
        pose[good, 4:] = world_from_camera[good, :3, 3]
    return pose


def intrinsics_from_coefficients(
    coefficients: Float[np.ndarray, "frame 4"], where: str
) -> Float[np.ndarray, "frame 3 3"]:
    """Convert (fx, fy, cx, cy) per frame to matrices. Raises CAP-004 for impossible values."""
    if not np.isfinite(coefficients).all() or np.any(coefficients[:, :2] <= 0):
        raise errors.broken_metadata(where, "the focal length must be positive")
    intrinsics = np.tile(np.eye(3), (len(coefficients), 1, 1))
    intrinsics[:, [0, 1, 0, 1], [0, 1, 2, 2]] = coefficients
    return intrinsics


def grid_size(depth_size: tuple[int, int], color_size: tuple[int, int]) -> tuple[int, int]:
    """Return the (height, width) of reprojected depth: the color's aspect ratio, the depth's longer side."""
    share = max(depth_size) / max(color_size)
    return round(color_size[0] * share), round(color_size[1] * share)


def reproject(
    depth: Float[np.ndarray, "depth_height depth_width"],
    camera: DepthCamera,
    color_intrinsics: Float[np.ndarray, "3 3"],
    color_size: tuple[int, int],
) -> Float[np.ndarray, "height width"]:
    """Return the depth that the color camera would measure, meters, 0 = unknown, on a grid of `grid_size`.

    Every known pixel is splatted to the cells that its footprint covers, the nearest surface wins.
    """
    height, width = size = grid_size(depth.shape, color_size)
    intrinsics = cameras.scale_intrinsics(color_intrinsics, color_size, size)
    known = depth > 0
    points_depth = cameras.back_project(depth, camera.intrinsics)[known]
    pixel, z = cameras.project(rigid.apply(rigid.inverse(camera.depth_from_color), points_depth), intrinsics)
    ahead = z > NEAREST_M
    pixel, z = pixel[ahead], z[ahead].astype(np.float32)
    footprint = intrinsics[[0, 1], [0, 1]] / camera.intrinsics[[0, 1], [0, 1]]
    cells = max(1, int(np.ceil(footprint.max())))
    nearest = np.full(height * width, np.inf, np.float32)
    for down in range(cells):
        for right in range(cells):
            corner = np.floor(pixel - (cells - 1) / 2).astype(int) + np.array([right, down])
            inside = (corner >= 0).all(1) & (corner < (width, height)).all(1)
            np.minimum.at(nearest, corner[inside, 1] * width + corner[inside, 0], z[inside])
    return np.where(np.isfinite(nearest), nearest, np.float32(0)).reshape(size)
