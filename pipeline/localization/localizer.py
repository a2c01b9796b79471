"""Localizers: estimate the camera pose of one RGB-D picture relative to a map (the scene or the agent).

Two kinds: nearest neighbors in a bank of rendered patches, followed by RANSAC over rigid alignments (depth
is known), and the paper's absolute pose regression. Descriptors are DAISY or those of the network that the
features were fitted with. The inlier ratio is calibrated to a probability. `load` opens a trained localizer,
`Localizer.localize` queries it.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, assert_never

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from safetensors.numpy import load_file, save_file

from pipeline.backends.descriptors import Describer
from pipeline.geometry import align, rigid
from pipeline.localization.networks import PoseRegressor
from pipeline.localization.patches import (
    Describe,
    PatchBank,
    Patches,
    PatchSampling,
    PcaBasis,
    extract_patches,
)

Kind = Literal["bank", "regression"]
MIN_INLIERS = 4
"""Least number of inliers of a pose: three points always fit."""
MIN_SECTOR_PATCHES = 6
"""Azimuth sectors with fewer patches are not queried."""
MAX_REGRESSED_POINTS = 60
"""Points that a regressed pose keeps, at most."""
LOGIT_LIMIT = 30.0
"""Logits are clipped to this, so that the exponential stays finite."""
NEWTON_STEPS, RIDGE = 50, (1e-3, 5e-3)
"""Steps and penalty (bias, slope) of the logistic fit."""


@dataclass(frozen=True)
class Calibration:
    """P(within 2 deg and 5 cm; agent: 15 deg and 8 cm) = logistic(bias + slope * inlier ratio), fitted on
    held-out renders."""

    bias: float
    slope: float

    def probability(self, inlier_ratio: Float[np.ndarray, "*any"] | float) -> Float[np.ndarray, "*any"]:
        """Return probabilities of inlier ratios."""
        logit = self.bias + self.slope * np.asarray(inlier_ratio, float)
        return 1.0 / (1.0 + np.exp(-np.clip(logit, -LOGIT_LIMIT, LOGIT_LIMIT)))


@dataclass(frozen=True)
class PoseHypothesis:
    """One pose of the camera in the map, and its probability."""

    map_from_camera: Float[np.ndarray, "4 4"]
    inlier_ratio: float
    """Share of the patches that are inliers; for a regressed pose its predicted certainty, 0..1."""
    probability: float
    points_map: Float[np.ndarray, "inlier 3"]
    points_camera: Float[np.ndarray, "inlier 3"]


@dataclass(frozen=True)
class RansacSolver:
    """RANSAC parameters that turn matched patches into one pose."""

    threshold_m: float
    """Inlier threshold: distance between a patch and its match, meters."""
    min_side_m: float
    """Least side of a RANSAC sample's triangle, meters."""
    iterations: int
    """Number of RANSAC samples of three matches."""
    sectors: int
    """Agent: the bank is queried once per azimuth sector, so that front and back both give a hypothesis."""


@dataclass(frozen=True)
class Localizer:
    """A trained localizer: descriptors, model, solver and calibration."""

    sampling: PatchSampling
    basis: PcaBasis
    model: PatchBank | PoseRegressor
    calibration: Calibration
    solver: RansacSolver
    describer: Describer = Describer()
    """Patch descriptor: DAISY at the sampling's radii, or a network with its weights."""
    describe: Describe | None = None
    """The loaded network; None: DAISY."""

    def localize(
        self,
        color: UInt8[np.ndarray, "height width 3"],
        depth: Float[np.ndarray, "depth_height depth_width"],
        depth_intrinsics: Float[np.ndarray, "3 3"],
        intrinsics: Float[np.ndarray, "3 3"],
        mask: Bool[np.ndarray, "height width"] | None = None,
    ) -> list[PoseHypothesis]:
        """Return pose hypotheses, best first; at most one for a scene.

        Depth in meters, intrinsics in pixels; ``mask`` limits the picture to where the target may be.
        """
        patches = extract_patches(
            color, depth, depth_intrinsics, intrinsics, mask, self.sampling, self.describe
        )
        return [] if patches is None else self.localize_patches(patches)

    def localize_patches(self, patches: Patches) -> list[PoseHypothesis]:
        """Return pose hypotheses for described patches, best first."""
        query = self.basis.project(patches.descriptors)
        match self.model:
            case PatchBank() as bank:
                sectors = [None] if self.sampling.target == "scene" else bank.sectors(self.solver.sectors)
                poses = [
                    self._solve(patches, *bank.match(query, sector))
                    for sector in sectors
                    if sector is None or len(sector) >= MIN_SECTOR_PATCHES
                ]
            case PoseRegressor() as net:
                poses = [self._regress(net, query, patches)]
            case _:
                assert_never(self.model)
        found = [pose for pose in poses if pose is not None]
        return sorted(found, key=lambda pose: -pose.inlier_ratio)

    def _solve(self, patches, matched, weight) -> PoseHypothesis | None:
        solver = self.solver
        map_from_camera, inlier = align.ransac_rigid(
            patches.points_camera,
            matched,
            threshold_m=solver.threshold_m,
            iterations=solver.iterations,
            rng=np.random.default_rng(0),
            weights=weight,
            min_side_m=solver.min_side_m,
        )
        if inlier.sum() < MIN_INLIERS:
            return None
        ratio, points_camera = float(inlier.mean()), patches.points_camera[inlier]
        return self._hypothesis(map_from_camera, ratio, matched[inlier], points_camera)

    def _regress(self, net, query, patches) -> PoseHypothesis:
        """Regress the map position of the camera's center, or of the animal's."""
        points = patches.points_camera
        anchor = np.zeros(3) if self.sampling.target == "scene" else np.median(points, axis=0)
        map_from_camera, certainty = net.regress(query, patches.cell, anchor)
        subset = points[:: max(1, len(points) // MAX_REGRESSED_POINTS)]
        return self._hypothesis(map_from_camera, certainty, rigid.apply(map_from_camera, subset), subset)

    def _hypothesis(self, map_from_camera, ratio, points_map, points_camera) -> PoseHypothesis:
        probability = float(self.calibration.probability(ratio))
        return PoseHypothesis(map_from_camera, ratio, probability, points_map, points_camera)


def calibrate(score: Float[np.ndarray, "sample"], good: Bool[np.ndarray, "sample"]) -> Calibration:
    """Fit P(good) by logistic regression on a score in 0..1 (Newton's method).

    One pseudo-observation at each end and a ridge keep the fit to separable data finite.
    """
    x = np.concatenate([score, [0.0, 1.0]])
    y = np.concatenate([good.astype(float), [0.0, 1.0]])
    design = np.stack([np.ones_like(x), x], axis=1)
    weights = np.zeros(2)
    penalty = np.diag(RIDGE)
    for _ in range(NEWTON_STEPS):
        p = 1 / (1 + np.exp(-np.clip(design @ weights, -LOGIT_LIMIT, LOGIT_LIMIT)))
        hessian = design.T @ (design * (p * (1 - p))[:, None]) + penalty
        weights = weights + np.linalg.solve(hessian, design.T @ (y - p) - penalty @ weights)
    return Calibration(float(weights[0]), float(weights[1]))


def save(folder: Path, localizer: Localizer, report: dict) -> None:
    """Write ``localizer.safetensors`` and ``localizer.json``; the report holds the held-out errors."""
    match localizer.model:
        case PatchBank() as bank:
            kind, arguments, arrays = "bank", {}, bank.arrays()
        case PoseRegressor() as net:
            state = {name: value.cpu().numpy() for name, value in net.state_dict().items()}
            kind, arguments, arrays = "regression", net.arguments, state
        case _:
            assert_never(localizer.model)
    basis = {f"basis.{name}": value for name, value in vars(localizer.basis).items()}
    contiguous = {name: np.ascontiguousarray(value) for name, value in (arrays | basis).items()}
    save_file(contiguous, folder / "localizer.safetensors")
    metadata = {"kind": kind, "arguments": arguments, "held_out": report}
    parts = ("sampling", "solver", "calibration", "describer")
    metadata |= {name: asdict(getattr(localizer, name)) for name in parts}
    (folder / "localizer.json").write_text(json.dumps(metadata, indent=1) + "\n")


def load(folder: Path, device: str = "cpu") -> Localizer:
    """Load a localizer, its networks on ``device``. Raises InputError MOD-001 to MOD-003."""
    metadata = json.loads((folder / "localizer.json").read_text())
    arrays = load_file(folder / "localizer.safetensors")
    basis = PcaBasis(arrays.pop("basis.mean"), arrays.pop("basis.components"))
    kind: Kind = metadata["kind"]
    match kind:
        case "bank":
            model = PatchBank(**arrays | {"descriptors": arrays["descriptors"].astype(np.float32)})
        case "regression":
            model = PoseRegressor(**metadata["arguments"])
            model.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()})
            model.to(device).eval()
        case _:
            assert_never(kind)
    sampling = PatchSampling(**{**metadata["sampling"], "radii_px": tuple(metadata["sampling"]["radii_px"])})
    calibration, solver = Calibration(**metadata["calibration"]), RansacSolver(**metadata["solver"])
    describer = Describer(**metadata["describer"])
    describe = open_describer(describer, device)
    return Localizer(sampling, basis, model, calibration, solver, describer, describe)


def open_describer(describer: Describer, device: str) -> Describe | None:
    """Load a descriptor network; None for DAISY, which `extract_patches` computes itself."""
    return None if describer.backend == "daisy" else describer.open(device)
