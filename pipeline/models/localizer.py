"""Localizers: one picture with depth -> where the camera is, relative to a map (the scene, or the agent).

A bank holds patches of many rendered views: a descriptor and the point of the map under it. A query's
patches find their nearest neighbours, and depth turns the matches into one rigid motion (RANSAC over
closed forms); the share of patches that agree is calibrated to a probability. `load` opens a trained
localizer, `Localizer.localize` answers. Views of the agent are brought to one scale by their depth.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, assert_never

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from safetensors.numpy import load_file, save_file

from pipeline.space import align, cameras, rigid

Target = Literal["scene", "agent"]


@dataclass(frozen=True)
class Sight:
    """How pictures are brought to the bank's scale and described."""

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
class Calibration:
    """P(within 2 deg and 5 cm; agent: 15 deg and 8 cm) = logistic(bias + slope * inlier ratio), fitted on held-out
    renders.
    """

    bias: float
    slope: float

    def probability(self, inlier_ratio: Float[np.ndarray, "*any"] | float) -> Float[np.ndarray, "*any"]:
        """Turn inlier ratios into probabilities."""
        return 1.0 / (1.0 + np.exp(-np.clip(self.bias + self.slope * np.asarray(inlier_ratio, float), -30, 30)))


@dataclass(frozen=True)
class Patches:
    """Patches of one picture: descriptors and what is known of the points under them."""

    descriptors: Float[np.ndarray, "patch channel"]
    points_camera: Float[np.ndarray, "patch 3"]


@dataclass(frozen=True)
class Bank:
    """All patches of all rendered views."""

    descriptors: Float[np.ndarray, "patch 64"]
    points_map: Float[np.ndarray, "patch 3"]
    view: Int[np.ndarray, "patch"]
    map_from_camera: Float[np.ndarray, "view 4 4"]
    mean: Float[np.ndarray, "channel"]
    components: Float[np.ndarray, "64 channel"]


@dataclass(frozen=True)
class Hypothesis:
    """One answer: the camera in the map, and how far to trust it."""

    map_from_camera: Float[np.ndarray, "4 4"]
    inlier_ratio: float
    probability: float
    nearest_view: int
    """The bank's view that most of the agreeing patches come from."""
    points_map: Float[np.ndarray, "inlier 3"]
    points_camera: Float[np.ndarray, "inlier 3"]

    @property
    def world_from_camera(self) -> Float[np.ndarray, "4 4"]:
        """The answer of a scene localizer, whose map is the world."""
        return self.map_from_camera


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
    """Describe one picture at the bank's scale. The mask says where the target is; None means everywhere. None: too
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
    pixel = pixel / scale + origin
    points = _lift(pixel, depth, depth_intrinsics, intrinsics)
    known = points[:, 2] > 0.1
    if mask is not None:
        column, row = np.clip(pixel.astype(int), 0, np.array(mask.shape[::-1]) - 1).T
        known &= mask[row, column] & (pixel >= 0).all(1) & (pixel < mask.shape[::-1]).all(1)
    return Patches(descriptors[known], points[known]) if known.sum() >= 6 else None


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


@dataclass(frozen=True)
class Localizer:
    """A bank of patches and how to query it."""

    sight: Sight
    bank: Bank
    calibration: Calibration
    threshold_m: float
    """Patches within this of their match agree, metres."""
    spread_m: float
    """Least side of a RANSAC triplet, metres."""
    iterations: int
    """RANSAC triplets."""
    sectors: int
    """Agent: the bank is asked once per sector of azimuth, so that front and back both answer."""

    def localize(
        self,
        color: UInt8[np.ndarray, "height width 3"],
        depth: Float[np.ndarray, "depth_height depth_width"],
        depth_intrinsics: Float[np.ndarray, "3 3"],
        intrinsics: Float[np.ndarray, "3 3"],
        mask: Bool[np.ndarray, "height width"] | None = None,
    ) -> list[Hypothesis]:
        """Return answers, best first; the scene's localizer gives at most one. Mask: where the target may be seen."""
        patches = see(color, depth, depth_intrinsics, intrinsics, mask, self.sight)
        return [] if patches is None else self.match(patches)

    def match(self, patches: Patches) -> list[Hypothesis]:
        """Answer for patches that are described already."""
        query = project(patches.descriptors, self.bank)
        hypotheses = [self._answer(query, patches, part) for part in self._parts()]
        return sorted((found for found in hypotheses if found is not None), key=lambda found: -found.inlier_ratio)

    def _parts(self) -> list[slice | Int[np.ndarray, "patch"]]:
        if self.sight.target == "scene":
            return [slice(None)]
        forward = self.bank.map_from_camera[:, :3, 3]
        sector = np.floor((np.arctan2(forward[:, 0], forward[:, 2]) / (2 * np.pi) + 0.5) * self.sectors).astype(int) % self.sectors
        return [np.flatnonzero(sector[self.bank.view] == index) for index in range(self.sectors)]

    def _answer(self, query, patches, part) -> Hypothesis | None:
        descriptors, points, view = self.bank.descriptors[part], self.bank.points_map[part], self.bank.view[part]
        if len(view) < 6:
            return None
        similarity = query @ descriptors.T
        nearest = similarity.argmax(1)
        weight = np.clip(similarity[np.arange(len(query)), nearest], 0.05, 1).astype(float)
        matched = points[nearest].astype(float)
        map_from_camera, inlier = align.ransac_rigid(
            patches.points_camera,
            matched,
            threshold_m=self.threshold_m,
            iterations=self.iterations,
            rng=np.random.default_rng(0),
            weights=weight**2,
            spread_m=self.spread_m,
        )
        if inlier.sum() < 4:
            return None
        ratio = float(inlier.mean())
        views, votes = np.unique(view[nearest[inlier]], return_counts=True)
        probability = float(self.calibration.probability(ratio))
        return Hypothesis(
            map_from_camera,
            ratio,
            probability,
            int(views[votes.argmax()]),
            matched[inlier],
            patches.points_camera[inlier],
        )


def project(descriptors: Float[np.ndarray, "patch channel"], bank: Bank) -> Float[np.ndarray, "patch 64"]:
    """Project descriptors onto the bank's principal axes and normalise them."""
    low = (descriptors.astype(np.float32) - bank.mean) @ bank.components.T
    return low / np.maximum(np.linalg.norm(low, axis=1, keepdims=True), 1e-6)


def calibrate(score: Float[np.ndarray, "sample"], good: Bool[np.ndarray, "sample"]) -> Calibration:
    """Fit P(good) as a logistic curve of a score in 0..1 by Newton steps; one pseudo-observation at each end and a
    ridge keep separable data finite.
    """
    x = np.concatenate([score, [0.0, 1.0]])
    y = np.concatenate([good.astype(float), [0.0, 1.0]])
    design = np.stack([np.ones_like(x), x], axis=1)
    weights = np.zeros(2)
    penalty = np.diag([1e-3, 5e-3])
    for _ in range(50):
        p = 1 / (1 + np.exp(-np.clip(design @ weights, -30, 30)))
        curvature = design.T @ (design * (p * (1 - p))[:, None]) + penalty
        weights = weights + np.linalg.solve(curvature, design.T @ (y - p) - penalty @ weights)
    return Calibration(float(weights[0]), float(weights[1]))


def errors(
    map_from_camera: Float[np.ndarray, "*batch 4 4"], truth: Float[np.ndarray, "*batch 4 4"]
) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
    """Return rotation error (degrees) and the distance of the camera centres (metres)."""
    rotation = np.rad2deg(rigid.rotation_angle(map_from_camera[..., :3, :3], truth[..., :3, :3]))
    return rotation, np.linalg.norm(map_from_camera[..., :3, 3] - truth[..., :3, 3], axis=-1)


def save(folder: Path, localizer: Localizer, report: dict) -> None:
    """Write ``localizer.safetensors`` and ``localizer.json``; the report holds what training measured."""
    bank = {name: np.ascontiguousarray(value) for name, value in vars(localizer.bank).items()}
    bank["descriptors"] = bank["descriptors"].astype(np.float16)
    save_file(bank, folder / "localizer.safetensors")
    table = {name: value for name, value in vars(localizer).items() if name not in ("bank", "sight", "calibration")}
    table |= {
        "kind": "bank",
        "sight": asdict(localizer.sight),
        "calibration": asdict(localizer.calibration),
        "held_out": report,
    }
    (folder / "localizer.json").write_text(json.dumps(table, indent=1) + "\n")


def load(folder: Path) -> Localizer:
    """Open a trained localizer."""
    table = json.loads((folder / "localizer.json").read_text())
    arrays = load_file(folder / "localizer.safetensors")
    arrays["descriptors"] = arrays["descriptors"].astype(np.float32)
    sight = Sight(**{**table["sight"], "radii_px": tuple(table["sight"]["radii_px"])})
    settings = {name: table[name] for name in ("threshold_m", "spread_m", "iterations", "sectors")}
    return Localizer(sight=sight, bank=Bank(**arrays), calibration=Calibration(**table["calibration"]), **settings)
