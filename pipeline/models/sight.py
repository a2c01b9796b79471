"""How a picture with depth becomes patches: brought to one scale, described by DAISY, projected, lifted by depth.

`see` describes one picture, `Basis` reduces its descriptors. Views of the agent are brought to one scale by their depth.
"""

from dataclasses import dataclass
from typing import Literal, assert_never

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.space import cameras

Target = Literal["scene", "agent"]


@dataclass(frozen=True)
class Sight:
    """How pictures are brought to the localizer's scale and described."""

    target: Target
    focal_px: float
    """Scene: pictures are resized to this focal length, pixels. Agent: crops are resized to so many pixels a metre."""
    window_px: int
    """Agent: edge of the square crop, pixels; scene: unused."""
    stride_px: int
    """Distance between patches in the resized picture, pixels."""
    radii_px: tuple[int, ...]
    """Radii of the DAISY descriptors that are concatenated, pixels."""


@dataclass(frozen=True)
class Patches:
    """Patches of one picture: descriptors and what is known of the points under them."""

    descriptors: Float[np.ndarray, "patch channel"]
    points_camera: Float[np.ndarray, "patch 3"]
    cell: Int[np.ndarray, "patch 2"]
    """Row and column of each patch on the picture's grid."""


@dataclass(frozen=True)
class Basis:
    """The principal axes that descriptors are reduced to."""

    mean: Float[np.ndarray, "channel"]
    components: Float[np.ndarray, "axis channel"]

    def project(self, descriptors: Float[np.ndarray, "patch channel"]) -> Float[np.ndarray, "patch axis"]:
        """Project descriptors onto the axes and normalise them."""
        low = (descriptors.astype(np.float32) - self.mean) @ self.components.T
        return low / np.maximum(np.linalg.norm(low, axis=1, keepdims=True), 1e-6)


def fit_basis(descriptors: Float[np.ndarray, "patch channel"], axes: int, rng: np.random.Generator, sample: int = 20000) -> Basis:
    """Fit the principal axes on a sample of descriptors."""
    chosen = rng.choice(len(descriptors), min(len(descriptors), sample), replace=False)
    known = descriptors[chosen].astype(np.float64)
    mean = known.mean(0)
    _, found = np.linalg.eigh((known - mean).T @ (known - mean))
    return Basis(mean.astype(np.float32), np.ascontiguousarray(found[:, ::-1][:, :axes].T).astype(np.float32))


def describe(
    picture: UInt8[np.ndarray, "height width 3"], sight: Sight
) -> tuple[Float[np.ndarray, "patch channel"], Float[np.ndarray, "patch 2"]]:
    """Return DAISY descriptors on the grid of a resized picture and the pixels of their centres (Tola et al. 2010)."""
    gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    offset = sight.stride_px // 2
    y, x = np.mgrid[offset : gray.shape[0] : sight.stride_px, offset : gray.shape[1] : sight.stride_px]
    pixel = np.stack([x.ravel(), y.ravel()], axis=-1).astype(np.float32)
    keypoints = [cv2.KeyPoint(float(column), float(row), 8) for column, row in pixel]
    parts = [
        cv2.xfeatures2d.DAISY_create(radius, 2, 6, 8, cv2.xfeatures2d.DAISY_NRM_PARTIAL).compute(gray, keypoints)[1]
        for radius in sight.radii_px
    ]
    return np.concatenate(parts, axis=1), pixel + 0.5


def see(
    color: UInt8[np.ndarray, "height width 3"],
    depth: Float[np.ndarray, "depth_height depth_width"],
    depth_intrinsics: Float[np.ndarray, "3 3"],
    intrinsics: Float[np.ndarray, "3 3"],
    mask: Bool[np.ndarray, "height width"] | None,
    sight: Sight,
) -> Patches | None:
    """Describe one picture at the localizer's scale. The mask says where the target is; None means everywhere. None: too
    little is seen.
    """
    match sight.target:
        case "scene":
            scale = sight.focal_px / intrinsics[0, 0]
            size = (round(color.shape[1] * scale), round(color.shape[0] * scale))
            picture, origin = cv2.resize(color, size, interpolation=cv2.INTER_AREA), np.zeros(2)
        case "agent":
            crop = _crop(color, depth, depth_intrinsics, intrinsics, mask, sight)
            if crop is None:
                return None
            picture, origin, scale = crop
        case _:
            assert_never(sight.target)
    descriptors, pixel = describe(picture, sight)
    cell = (pixel[:, ::-1] / sight.stride_px).astype(int)
    pixel = pixel / scale + origin
    points = _lift(pixel, depth, depth_intrinsics, intrinsics)
    known = points[:, 2] > 0.1
    if mask is not None:
        column, row = np.clip(pixel.astype(int), 0, np.array(mask.shape[::-1]) - 1).T
        known &= mask[row, column] & (pixel >= 0).all(1) & (pixel < mask.shape[::-1]).all(1)
    return Patches(descriptors[known], points[known], cell[known]) if known.sum() >= 6 else None


def _crop(color, depth, depth_intrinsics, intrinsics, mask, sight):
    """Cut a square of fixed size in metres around the mask, grey outside it; None without depth in the mask."""
    row, column = np.nonzero(mask)
    if len(row) < 30:
        return None
    points = _lift(np.stack([column, row], 1)[:: max(1, len(row) // 400)] + 0.5, depth, depth_intrinsics, intrinsics)
    known = points[:, 2] > 0.1
    if known.sum() < 10:
        return None
    scale = sight.focal_px * float(np.median(points[known, 2])) / intrinsics[0, 0]
    half = sight.window_px / 2 / scale
    origin = np.array([(column.min() + column.max() + 1) / 2, (row.min() + row.max() + 1) / 2]) - half
    warp = np.array([[scale, 0, -origin[0] * scale], [0, scale, -origin[1] * scale]])
    filled = np.where(mask[..., None], color, np.uint8(128))
    return (
        cv2.warpAffine(filled, warp, (sight.window_px, sight.window_px), flags=cv2.INTER_LINEAR, borderValue=(128, 128, 128)),
        origin,
        scale,
    )


def _lift(pixel, depth, depth_intrinsics, intrinsics):
    """Lift colour pixels to camera axes by the depth image, whose camera is the same; z = 0 where depth is unknown."""
    ray = cameras.unproject(pixel, intrinsics)
    target, _ = cameras.project(ray, depth_intrinsics)
    column, row = np.floor(target).astype(int).T
    inside = (row >= 0) & (column >= 0) & (row < depth.shape[0]) & (column < depth.shape[1])
    z = np.where(inside, depth[np.clip(row, 0, depth.shape[0] - 1), np.clip(column, 0, depth.shape[1] - 1)], 0)
    return ray * z[:, None]
