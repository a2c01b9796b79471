"""What all kinds of localizers are made of: rendered views as patches; and how the finished one is measured."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.models import localizer as model
from pipeline.models.patch_bank import Bank
from pipeline.models.sight import Basis, Patches, Sight, fit_basis, see
from pipeline.progress import track
from pipeline.space import rigid
from stages.train_localizer.views import Photograph

GOOD = {"scene": (2.0, 0.05), "agent": (15.0, 0.08)}
"""Rotation (degrees) and translation (metres) within which an answer counts as right."""


@dataclass(frozen=True)
class HeldOut:
    """How the localizer answers on rendered views outside its bank."""

    rotation_deg: Float[np.ndarray, "view"]
    translation_m: Float[np.ndarray, "view"]
    """NaN in both where it gave no answer."""
    inlier_ratio: Float[np.ndarray, "view"]
    good: Bool[np.ndarray, "view"]
    views: list[Photograph]


def look(view: Photograph, sight: Sight) -> Patches | None:
    """Describe a view as a query would be."""
    mask = None if sight.target == "scene" else view.seen
    return see(view.color, view.depth, view.intrinsics, view.intrinsics, mask, sight)


@dataclass(frozen=True)
class Described:
    """All views as reduced patches, one after the other."""

    basis: Basis
    descriptors: Float[np.ndarray, "patch axis"]
    patches: list[Patches]
    """Per described view."""
    view: Int[np.ndarray, "described"]
    map_from_camera: Float[np.ndarray, "view 4 4"]

    @property
    def points_map(self) -> Float[np.ndarray, "patch 3"]:
        """The true point of the map under each patch."""
        posed = zip(self.map_from_camera[self.view], self.patches, strict=True)
        return np.concatenate([rigid.apply(pose, patches.points_camera) for pose, patches in posed]).astype(np.float32)

    @property
    def counts(self) -> list[int]:
        """Patches per described view."""
        return [len(patches.points_camera) for patches in self.patches]

    def bank(self) -> Bank:
        """Keep everything."""
        kept = self.descriptors.astype(np.float16).astype(np.float32)
        return Bank(kept, self.points_map, np.repeat(self.view, self.counts).astype(np.int32), self.map_from_camera)


def describe_views(views: list[Photograph], sight: Sight, axes: int, rng: np.random.Generator) -> Described:
    """Describe all views and reduce their descriptors to principal axes."""
    found = [(index, patches) for index, view in enumerate(track(views, "describing views")) if (patches := look(view, sight)) is not None]
    descriptors = np.concatenate([patches.descriptors for _, patches in found])
    basis = fit_basis(descriptors, axes, rng)
    poses = np.stack([view.map_from_camera for view in views])
    return Described(basis, basis.project(descriptors), [patches for _, patches in found], np.array([index for index, _ in found]), poses)


def hold_out(localizer: model.Localizer, draw: Callable[[], Photograph], count: int) -> HeldOut:
    """Ask the localizer about fresh views."""
    views = [draw() for _ in range(count)]
    rotation, translation, ratio = np.full(count, np.nan), np.full(count, np.nan), np.zeros(count)
    for index, view in enumerate(track(views, "held-out views")):
        patches = look(view, localizer.sight)
        answers = localizer.match(patches) if patches is not None else []
        if answers:
            poses = np.stack([answers[0].map_from_camera, view.map_from_camera])
            found, truth = rigid.inverse(poses) if localizer.sight.target == "agent" else poses
            rotation[index], translation[index] = model.errors(found, truth)
            ratio[index] = answers[0].inlier_ratio
    limits = GOOD[localizer.sight.target]
    return HeldOut(rotation, translation, ratio, (rotation <= limits[0]) & (translation <= limits[1]), views)
