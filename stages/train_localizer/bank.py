"""Make a bank of rendered views and calibrate it on views that it does not hold."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.models import localizer as model
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


def look(view: Photograph, sight: model.Sight) -> model.Patches | None:
    """Describe a view as a query would be."""
    mask = None if sight.target == "scene" else view.seen
    return model.see(view.color, view.depth, view.intrinsics, view.intrinsics, mask, sight)


def make_bank(views: list[Photograph], sight: model.Sight, channels: int, rng: np.random.Generator) -> model.Bank:
    """Describe all views, fit the principal axes of their descriptors and keep the projections."""
    seen = [
        (index, view, patches) for index, view in enumerate(track(views, "describing views")) if (patches := look(view, sight)) is not None
    ]
    descriptors = np.concatenate([patches.descriptors for _, _, patches in seen])
    sample = descriptors[rng.choice(len(descriptors), min(len(descriptors), 20000), replace=False)].astype(np.float64)
    mean = sample.mean(0)
    _, axes = np.linalg.eigh((sample - mean).T @ (sample - mean))
    bank = model.Bank(
        descriptors=np.zeros((0, channels), np.float32),
        points_map=np.concatenate([rigid.apply(view.map_from_camera, patches.points_camera) for _, view, patches in seen]).astype(
            np.float32
        ),
        view=np.repeat([index for index, _, _ in seen], [len(patches.points_camera) for _, _, patches in seen]).astype(np.int32),
        map_from_camera=np.stack([view.map_from_camera for view in views]),
        mean=mean.astype(np.float32),
        components=np.ascontiguousarray(axes[:, ::-1][:, :channels].T).astype(np.float32),
    )
    return replace(bank, descriptors=model.project(descriptors, bank).astype(np.float16).astype(np.float32))


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
