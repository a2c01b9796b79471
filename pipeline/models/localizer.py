"""Localizers: one picture with depth -> where the camera is, relative to a map (the scene, or the agent).

Three kinds answer: a bank of patches of rendered views, a network that tells each patch its point of
the map (both solved by RANSAC over closed forms, since depth is there), and the paper's regressor of
poses. The share of patches that agree is calibrated to a probability. `load` opens a trained
localizer, `Localizer.localize` answers.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, assert_never

import numpy as np
from jaxtyping import Bool, Float, UInt8
from safetensors.numpy import load_file, save_file

from pipeline.models.patch_bank import Bank
from pipeline.models.pose_regressor import PoseNet
from pipeline.models.scene_coordinates import CoordinateNet
from pipeline.models.sight import Basis, Patches, Sight, see
from pipeline.space import align, rigid

Kind = Literal["bank", "coordinates", "regression"]


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
class Hypothesis:
    """One answer: the camera in the map, and how far to trust it."""

    map_from_camera: Float[np.ndarray, "4 4"]
    inlier_ratio: float
    """Share of the patches that agree; of a regressed pose its own certainty, 0..1."""
    probability: float
    points_map: Float[np.ndarray, "inlier 3"]
    points_camera: Float[np.ndarray, "inlier 3"]

    @property
    def world_from_camera(self) -> Float[np.ndarray, "4 4"]:
        """The answer of a scene localizer, whose map is the world."""
        return self.map_from_camera


@dataclass(frozen=True)
class Solver:
    """How matches of patches become one motion."""

    threshold_m: float
    """Patches within this of their match agree, metres."""
    spread_m: float
    """Least side of a RANSAC triplet, metres."""
    iterations: int
    """RANSAC triplets."""
    sectors: int
    """Agent: a bank is asked once per sector of azimuth, so that front and back both answer."""


@dataclass(frozen=True)
class Localizer:
    """What was learnt of a map, and how to query it."""

    sight: Sight
    basis: Basis
    model: Bank | CoordinateNet | PoseNet
    calibration: Calibration
    solver: Solver

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
        query = self.basis.project(patches.descriptors)
        match self.model:
            case Bank() as bank:
                parts = [None] if self.sight.target == "scene" else bank.sectors(self.solver.sectors)
                answers = [self._solve(patches, *bank.correspond(query, part)) for part in parts if part is None or len(part) >= 6]
            case CoordinateNet() as net:
                answers = [self._solve(patches, *net.correspond(query))]
            case PoseNet() as net:
                answers = [self._regressed(patches, *net.answer(query, patches.cell, self._anchor(patches)))]
            case _:
                assert_never(self.model)
        return sorted((found for found in answers if found is not None), key=lambda found: -found.inlier_ratio)

    def _solve(self, patches, matched, weight) -> Hypothesis | None:
        solver = self.solver
        map_from_camera, inlier = align.ransac_rigid(
            patches.points_camera,
            matched,
            threshold_m=solver.threshold_m,
            iterations=solver.iterations,
            rng=np.random.default_rng(0),
            weights=weight,
            spread_m=solver.spread_m,
        )
        if inlier.sum() < 4:
            return None
        return self._hypothesis(map_from_camera, float(inlier.mean()), matched[inlier], patches.points_camera[inlier])

    def _anchor(self, patches) -> Float[np.ndarray, "3"]:
        """Return the point whose place a regressor tells: the camera's centre, or the middle of the animal."""
        return np.zeros(3) if self.sight.target == "scene" else np.median(patches.points_camera, axis=0)

    def _regressed(self, patches, map_from_camera, certainty) -> Hypothesis:
        some = patches.points_camera[:: max(1, len(patches.points_camera) // 60)]
        return self._hypothesis(map_from_camera, certainty, rigid.apply(map_from_camera, some), some)

    def _hypothesis(self, map_from_camera, ratio, points_map, points_camera) -> Hypothesis:
        return Hypothesis(map_from_camera, ratio, float(self.calibration.probability(ratio)), points_map, points_camera)


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
    match localizer.model:
        case Bank() as bank:
            kind, shape, arrays = "bank", {}, bank.arrays()
        case CoordinateNet() as net:
            kind, shape, arrays = "coordinates", net.shape(), {name: value.numpy() for name, value in net.state_dict().items()}
        case PoseNet() as net:
            kind, shape, arrays = "regression", net.shape(), {name: value.numpy() for name, value in net.state_dict().items()}
        case _:
            assert_never(localizer.model)
    basis = {f"basis.{name}": value for name, value in vars(localizer.basis).items()}
    save_file({name: np.ascontiguousarray(value) for name, value in (arrays | basis).items()}, folder / "localizer.safetensors")
    table = {"kind": kind, "shape": shape, "held_out": report}
    table |= {name: asdict(getattr(localizer, name)) for name in ("sight", "solver", "calibration")}
    (folder / "localizer.json").write_text(json.dumps(table, indent=1) + "\n")


def load(folder: Path) -> Localizer:
    """Open a trained localizer."""
    table = json.loads((folder / "localizer.json").read_text())
    arrays = load_file(folder / "localizer.safetensors")
    basis = Basis(arrays.pop("basis.mean"), arrays.pop("basis.components"))
    kind: Kind = table["kind"]
    match kind:
        case "bank":
            model = Bank.from_arrays(arrays)
        case "coordinates":
            model = CoordinateNet(**table["shape"]).with_weights(arrays)
        case "regression":
            model = PoseNet(**table["shape"]).with_weights(arrays)
        case _:
            assert_never(kind)
    sight = Sight(**{**table["sight"], "radii_px": tuple(table["sight"]["radii_px"])})
    return Localizer(sight, basis, model, Calibration(**table["calibration"]), Solver(**table["solver"]))
