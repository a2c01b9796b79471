"""Training data of all kinds of localizers (rendered views as patches), and evaluation on held-out views."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.core.progress import track
from pipeline.geometry import rigid
from pipeline.localization import localizer as localizers
from pipeline.localization.patches import (
    Describe,
    PatchBank,
    Patches,
    PatchSampling,
    PcaBasis,
    Target,
    extract_patches,
    fit_pca,
)
from pipeline.metrics.pose_errors import pose_errors
from stages.train_localizer.views import RenderedView

POSE_TOLERANCE: dict[Target, tuple[float, float]] = {"scene": (2.0, 0.05), "agent": (15.0, 0.08)}
"""Largest rotation error (degrees) and translation error (meters) of a correct pose."""


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors on held-out rendered views."""

    rotation_deg: Float[np.ndarray, "view"]
    translation_m: Float[np.ndarray, "view"]
    """Both NaN where no pose was found."""
    inlier_ratio: Float[np.ndarray, "view"]
    good: Bool[np.ndarray, "view"]
    views: list[RenderedView]


def describe_view(view: RenderedView, sampling: PatchSampling, describe: Describe | None) -> Patches | None:
    """Describe a view in the same way as a query."""
    mask = None if sampling.target == "scene" else view.seen
    return extract_patches(view.color, view.depth, view.intrinsics, view.intrinsics, mask, sampling, describe)


@dataclass(frozen=True)
class DescribedViews:
    """Patches of all views, concatenated, with descriptors in PCA space."""

    basis: PcaBasis
    descriptors: Float[np.ndarray, "patch axis"]
    patches: list[Patches]
    """Per described view."""
    view: Int[np.ndarray, "described"]
    map_from_camera: Float[np.ndarray, "view 4 4"]

    @property
    def points_map(self) -> Float[np.ndarray, "patch 3"]:
        """The true map point of each patch, meters."""
        posed = zip(self.map_from_camera[self.view], self.patches, strict=True)
        return np.concatenate([rigid.apply(pose, patches.points_camera) for pose, patches in posed]).astype(
            np.float32
        )

    @property
    def counts(self) -> list[int]:
        """Patches per described view."""
        return [len(patches.points_camera) for patches in self.patches]

    def bank(self) -> PatchBank:
        """Return a bank of all patches, with descriptors rounded to half precision as when stored."""
        stored = self.descriptors.astype(np.float16).astype(np.float32)
        view = np.repeat(self.view, self.counts).astype(np.int32)
        return PatchBank(stored, self.points_map, view, self.map_from_camera)


def describe_views(
    views: list[RenderedView],
    sampling: PatchSampling,
    axes: int,
    describe: Describe | None,
    rng: np.random.Generator,
) -> DescribedViews:
    """Describe all views and project their descriptors to principal components."""
    described = [
        (index, patches)
        for index, view in enumerate(track(views, "describing views"))
        if (patches := describe_view(view, sampling, describe)) is not None
    ]
    descriptors = np.concatenate([patches.descriptors for _, patches in described])
    basis = fit_pca(descriptors, min(axes, descriptors.shape[1]), rng)
    return DescribedViews(
        basis,
        basis.project(descriptors),
        [patches for _, patches in described],
        np.array([index for index, _ in described]),
        np.stack([view.map_from_camera for view in views]),
    )


def evaluate(localizer: localizers.Localizer, draw: Callable[[], RenderedView], count: int) -> HeldOutErrors:
    """Localize new views; for the agent, errors are those of the agent's pose in the camera frame."""
    views = [draw() for _ in range(count)]
    rotation, translation, ratio = np.full(count, np.nan), np.full(count, np.nan), np.zeros(count)
    for index, view in enumerate(track(views, "held-out views")):
        patches = describe_view(view, localizer.sampling, localizer.describe)
        hypotheses = localizer.localize_patches(patches) if patches is not None else []
        if hypotheses:
            poses = np.stack([hypotheses[0].map_from_camera, view.map_from_camera])
            estimate, truth = rigid.inverse(poses) if localizer.sampling.target == "agent" else poses
            error = pose_errors(estimate[None], truth[None])
            rotation[index], translation[index] = error.degrees[0], error.meters[0]
            ratio[index] = hypotheses[0].inlier_ratio
    tolerance = POSE_TOLERANCE[localizer.sampling.target]
    good = (rotation <= tolerance[0]) & (translation <= tolerance[1])
    return HeldOutErrors(rotation, translation, ratio, good, views)
