"""Patches of an RGB-D picture: resized to one scale, described by DAISY or DINOv2, back-projected by depth.

`extract_patches` describes one picture, `PcaBasis` reduces its descriptors, `PatchBank` finds nearest
neighbors among patches of rendered views. Views of the agent are scaled by their depth.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, assert_never

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from pipeline.geometry import cameras

Target = Literal["scene", "agent"]
Describe = Callable[[np.ndarray, int], np.ndarray]
"""``describe(color, stride_px) -> [rows columns channel]``, see `pipeline.backends.descriptors`."""

MIN_PATCHES = 6
"""A picture with fewer patches is not localized."""
MIN_MASK_PX, MIN_DEPTH_PX, DEPTH_SAMPLES = 30, 10, 400
"""Agent: least mask pixels, least of them with depth, and mask pixels sampled for the median depth."""
MIN_DEPTH_M = 0.1
"""Smaller depth counts as missing, meters."""
GRAY = 128
"""Gray value outside the mask."""
KEYPOINT_PX = 8.0
"""Size of DAISY's keypoints, pixels; no effect on unrotated descriptors."""
PCA_SAMPLES = 20_000
"""Descriptors sampled for the PCA."""
MIN_NORM = 1e-6
BANK_BLOCK = 4096
"""Bank patches per matrix product, so that the similarities fit the processor's cache."""
MIN_SIMILARITY = 0.05
"""Floor of the cosine similarity, so that every match keeps some weight."""


@dataclass(frozen=True)
class PatchSampling:
    """Scale of the pictures and grid of the patches."""

    target: Target
    focal_px: float
    """Scene: focal length that pictures are resized to, pixels. Agent: pixels per meter of the crops."""
    window_px: int
    """Agent: edge of the square crop, pixels; scene: unused."""
    stride_px: int
    """Distance between patches in the resized picture, pixels."""
    radii_px: tuple[int, ...]
    """Radii of the concatenated DAISY descriptors, pixels."""


@dataclass(frozen=True)
class Patches:
    """Patches of one picture: descriptors and 3D points."""

    descriptors: Float[np.ndarray, "patch channel"]
    points_camera: Float[np.ndarray, "patch 3"]
    """Meters."""
    cell: Int[np.ndarray, "patch 2"]
    """Row and column of each patch on the picture's grid."""


@dataclass(frozen=True)
class PcaBasis:
    """Principal components of descriptors."""

    mean: Float[np.ndarray, "channel"]
    components: Float[np.ndarray, "axis channel"]

    def project(self, descriptors: Float[np.ndarray, "patch channel"]) -> Float[np.ndarray, "patch axis"]:
        """Project descriptors onto the components and normalize to unit length."""
        reduced = (descriptors.astype(np.float32) - self.mean) @ self.components.T
        return reduced / np.maximum(np.linalg.norm(reduced, axis=1, keepdims=True), MIN_NORM)


def fit_pca(descriptors: Float[np.ndarray, "patch channel"], axes: int, rng: np.random.Generator) -> PcaBasis:
    """Fit the principal components to a sample of descriptors."""
    chosen = rng.choice(len(descriptors), min(len(descriptors), PCA_SAMPLES), replace=False)
    valid = descriptors[chosen].astype(np.float64)
    mean = valid.mean(0)
    _, vectors = np.linalg.eigh((valid - mean).T @ (valid - mean))
    components = np.ascontiguousarray(vectors[:, ::-1][:, :axes].T).astype(np.float32)
    return PcaBasis(mean.astype(np.float32), components)


@dataclass(frozen=True)
class PatchBank:
    """All patches of all rendered views."""

    descriptors: Float[np.ndarray, "patch axis"]
    """Unit length."""
    points_map: Float[np.ndarray, "patch 3"]
    """Meters."""
    view: Int[np.ndarray, "patch"]
    map_from_camera: Float[np.ndarray, "view 4 4"]

    def match(
        self, query: Float[np.ndarray, "query axis"], subset: Int[np.ndarray, "subset"] | None = None
    ) -> tuple[Float[np.ndarray, "query 3"], Float[np.ndarray, "query"]]:
        """Return the map point of each query's nearest neighbor (optionally in a subset), and its weight."""
        descriptors, points = self.descriptors, self.points_map
        if subset is not None:
            descriptors, points = descriptors[subset], points[subset]
        nearest, similarity = np.zeros(len(query), int), np.full(len(query), -np.inf, np.float32)
        for first in range(0, len(descriptors), BANK_BLOCK):
            similarities = query @ descriptors[first : first + BANK_BLOCK].T
            best = similarities.argmax(1)
            score = similarities[np.arange(len(query)), best]
            nearest = np.where(score > similarity, best + first, nearest)
            similarity = np.maximum(similarity, score)
        return points[nearest].astype(float), np.clip(similarity, MIN_SIMILARITY, 1).astype(float) ** 2

    def sectors(self, count: int) -> list[Int[np.ndarray, "part"]]:
        """Group patch indices by the azimuth of their view's camera."""
        eye = self.map_from_camera[:, :3, 3]
        sector = np.floor((np.arctan2(eye[:, 0], eye[:, 2]) / (2 * np.pi) + 0.5) * count).astype(int) % count
        return [np.flatnonzero(sector[self.view] == index) for index in range(count)]

    def arrays(self) -> dict[str, Shaped[np.ndarray, "..."]]:
        """Return the arrays to store."""
        return vars(self) | {"descriptors": self.descriptors.astype(np.float16)}


def describe_daisy(
    picture: UInt8[np.ndarray, "height width 3"], sampling: PatchSampling
) -> tuple[Float[np.ndarray, "patch channel"], Float[np.ndarray, "patch 2"]]:
    """Return dense DAISY descriptors (Tola et al. 2010) of a resized picture and their centers, pixels."""
    gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    offset = sampling.stride_px // 2
    y, x = np.mgrid[offset : gray.shape[0] : sampling.stride_px, offset : gray.shape[1] : sampling.stride_px]
    pixel = np.stack([x.ravel(), y.ravel()], axis=-1).astype(np.float32)
    keypoints = [cv2.KeyPoint(float(column), float(row), KEYPOINT_PX) for column, row in pixel]
    create, norm = cv2.xfeatures2d.DAISY.create, cv2.xfeatures2d.DAISY_NRM_PARTIAL
    parts = [create(radius, 2, 6, 8, norm).compute(gray, keypoints)[1] for radius in sampling.radii_px]
    return np.concatenate(parts, axis=1), pixel + 0.5


def describe_cells(
    picture: UInt8[np.ndarray, "height width 3"], stride_px: int, describe: Describe
) -> tuple[Float[np.ndarray, "patch channel"], Float[np.ndarray, "patch 2"]]:
    """Return a network's descriptors of a resized picture and their cell centers, pixels."""
    cells = describe(picture, stride_px)
    center = (cameras.pixel_grid(*cells.shape[:2]) * stride_px).reshape(-1, 2)
    return cells.reshape(-1, cells.shape[-1]), center


def extract_patches(
    color: UInt8[np.ndarray, "height width 3"],
    depth: Float[np.ndarray, "depth_height depth_width"],
    depth_intrinsics: Float[np.ndarray, "3 3"],
    intrinsics: Float[np.ndarray, "3 3"],
    mask: Bool[np.ndarray, "height width"] | None,
    sampling: PatchSampling,
    describe: Describe | None = None,
) -> Patches | None:
    """Describe one picture at the localizer's scale; None if too little of the target is visible.

    Args:
        color, depth, depth_intrinsics, intrinsics: RGB, meters (0 = unknown), pixels; one camera center.
        mask: pixels of the target; None: all.
        sampling: scale and grid.
        describe: a network; None: DAISY at the sampling's radii.
    """
    match sampling.target:
        case "scene":
            scale = sampling.focal_px / intrinsics[0, 0]
            size = (round(color.shape[1] * scale), round(color.shape[0] * scale))
            picture, origin = cv2.resize(color, size, interpolation=cv2.INTER_AREA), np.zeros(2)
        case "agent":
            assert mask is not None, "the agent is cropped by its mask"
            crop = _crop(color, depth, depth_intrinsics, intrinsics, mask, sampling)
            if crop is None:
                return None
            picture, origin, scale = crop
        case _:
            assert_never(sampling.target)
    descriptors, pixel = (
        describe_daisy(picture, sampling)
        if describe is None
        else describe_cells(picture, sampling.stride_px, describe)
    )
    cell = (pixel[:, ::-1] / sampling.stride_px).astype(int)
    pixel = pixel / scale + origin
    points = cameras.back_project_pixels(pixel, intrinsics, depth, depth_intrinsics)
    valid = points[:, 2] > MIN_DEPTH_M
    if mask is not None:
        valid &= cameras.sample_nearest(mask, pixel)
    enough = valid.sum() >= MIN_PATCHES
    return Patches(descriptors[valid], points[valid], cell[valid]) if enough else None


def _crop(color, depth, depth_intrinsics, intrinsics, mask, sampling):
    """Crop a square of fixed metric size around the mask, gray outside the mask; None without depth."""
    row, column = np.nonzero(mask)
    if len(row) < MIN_MASK_PX:
        return None
    sample = cameras.pixel_centers(row, column)[:: max(1, len(row) // DEPTH_SAMPLES)]
    points = cameras.back_project_pixels(sample, intrinsics, depth, depth_intrinsics)
    valid = points[:, 2] > MIN_DEPTH_M
    if valid.sum() < MIN_DEPTH_PX:
        return None
    scale = sampling.focal_px * float(np.median(points[valid, 2])) / intrinsics[0, 0]
    half = sampling.window_px / 2 / scale
    origin = np.array([(column.min() + column.max() + 1) / 2, (row.min() + row.max() + 1) / 2]) - half
    warp = np.array([[scale, 0, -origin[0] * scale], [0, scale, -origin[1] * scale]])
    size = (sampling.window_px, sampling.window_px)
    filled = np.where(mask[..., None], color, np.uint8(GRAY))
    crop = cv2.warpAffine(filled, warp, size, flags=cv2.INTER_LINEAR, borderValue=(GRAY, GRAY, GRAY))
    return crop, origin, scale
