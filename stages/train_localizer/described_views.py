"""What all kinds of localizers learn from: rendered views as patches; and how the trained one is measured."""

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
from stages.train_localizer.views import RenderedView

GOOD: dict[Target, tuple[float, float]] = {"scene": (2.0, 0.05), "agent": (15.0, 0.08)}
"""Rotation (degrees) and translation (metres) within which a pose counts as right."""


@dataclass(frozen=True)
class HeldOut:
    """Errors on rendered views that were not learned."""

    rotation_deg: Float[np.ndarray, "view"]
    translation_m: Float[np.ndarray, "view"]
    """NaN in both where there is no pose."""
    inlier_ratio: Float[np.ndarray, "view"]
    good: Bool[np.ndarray, "view"]
    views: list[RenderedView]


def patches_of(view: RenderedView, sampling: PatchSampling, describe: Describe | None) -> Patches | None:
    """Describe a view as a query would be."""
    mask = None if sampling.target == "scene" else view.seen
    return extract_patches(view.color, view.depth, view.intrinsics, view.intrinsics, mask, sampling, describe)


@dataclass(frozen=True)
class DescribedViews:
    """All views as reduced patches, one after the other."""

    basis: PcaBasis
    descriptors: Float[np.ndarray, "patch axis"]
    patches: list[Patches]
    """Per described view."""
    view: Int[np.ndarray, "described"]
    map_from_camera: Float[np.ndarray, "view 4 4"]

    @property
    def points_map(self) -> Float[np.ndarray, "patch 3"]:
        """The true point of the map under each patch, metres."""
        posed = zip(self.map_from_camera[self.view], self.patches, strict=True)
        return np.concatenate([rigid.apply(pose, patches.points_camera) for pose, patches in posed]).astype(
            np.float32
        )

    @property
    def counts(self) -> list[int]:
        """Patches per described view."""
        return [len(patches.points_camera) for patches in self.patches]

    def bank(self) -> PatchBank:
        """Keep everything; descriptors as they are stored (half precision)."""
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
    """Describe all views and reduce their descriptors to principal axes."""
    described = [
        (index, patches)
        for index, view in enumerate(track(views, "describing views"))
        if (patches := patches_of(view, sampling, describe)) is not None
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


def hold_out(localizer: localizers.Localizer, draw: Callable[[], RenderedView], count: int) -> HeldOut:
    """Localize fresh views; the agent's error is that of the agent in the camera's frame."""
    views = [draw() for _ in range(count)]
    rotation, translation, ratio = np.full(count, np.nan), np.full(count, np.nan), np.zeros(count)
    for index, view in enumerate(track(views, "held-out views")):
        patches = patches_of(view, localizer.sampling, localizer.describe)
        answers = localizer.localize_patches(patches) if patches is not None else []
        if answers:
            poses = np.stack([answers[0].map_from_camera, view.map_from_camera])
            estimate, truth = rigid.inverse(poses) if localizer.sampling.target == "agent" else poses
            rotation[index], translation[index] = localizers.errors(estimate, truth)
            ratio[index] = answers[0].inlier_ratio
    limits = GOOD[localizer.sampling.target]
    return HeldOut(rotation, translation, ratio, (rotation <= limits[0]) & (translation <= limits[1]), views)
