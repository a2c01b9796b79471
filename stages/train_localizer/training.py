"""Train a localizer from a template: views, descriptors, model, calibration."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import assert_never

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.backends.descriptors import Describer
from pipeline.core.errors import InputError
from pipeline.core.progress import track
from pipeline.data.clips import Clip
from pipeline.data.templates import SkinTable
from pipeline.geometry import cameras, subsampling
from pipeline.geometry.meshes import Mesh, RayCaster
from pipeline.geometry.size import body_length_m
from pipeline.localization import localizer as localizers
from pipeline.localization.patches import Patches, PatchSampling, Target
from stages.train_localizer import described_views, networks, views
from stages.train_localizer.config import AgentConfig, Config, SceneConfig
from stages.train_localizer.views import RenderedView

MAX_SEED = 2**31
"""Exclusive upper bound of random seeds."""
MAX_DRAWS = 200
"""Attempts at drawing a plausible random view."""
PCA_AXES = 64
"""Principal components of the descriptors; more do not help on the built-in cat."""
SCENE_SAMPLING = PatchSampling("scene", 120.0, 0, 8, (6, 18))
"""Resized to a focal length of 120 px, a patch every 8 px (4 degrees), radii of 6 and 18 px."""
AGENT_SAMPLING = PatchSampling("agent", 66.0, 104, 4, (6, 14))
"""For an animal of 1 m: 66 px per body length, crops of 1.58 lengths, which a long tail fits into, a patch
every 4 px, radii of 6 and 14 px."""
SOLVERS: dict[Target, localizers.RansacSolver] = {
    "scene": localizers.RansacSolver(threshold_m=0.1, min_side_m=0.25, iterations=600, sectors=1),
    "agent": localizers.RansacSolver(threshold_m=0.067, min_side_m=0.1, iterations=600, sectors=6),
}
"""Inlier thresholds of a patch's size; RANSAC samples wider than a few patches; of an animal of 1 m."""
RENDER_SCALE = 2
"""Resolution of rendered agent views relative to that of the crop."""
VIEW_MARGIN, MIN_DISTANCE_M, VIEW_PX = 2.4, 0.3, (64, 240)
"""Agent views: side over the animal's radius, least distance to its surface (meters), bounds of the side."""


@dataclass(frozen=True)
class TrainingViews:
    """Training views of a localizer, and generators of further views and queries."""

    target: Target
    sampling: PatchSampling
    solver: localizers.RansacSolver
    pictures: list[RenderedView]
    draw: Callable[[np.random.Generator], RenderedView]
    """Render a random training view."""
    draw_query: Callable[[np.random.Generator], RenderedView]
    """Render a query with depth noise and occluders, as from a phone."""
    held_out: int
    """Number of held-out queries."""


def scene_views(
    mesh: Mesh,
    walk: Float[np.ndarray, "frame 4 4"],
    floor_m: float,
    clip: Clip,
    config: SceneConfig,
    rng: np.random.Generator,
) -> TrainingViews:
    """Render random views of the scene and add frames of the walk-through, whose camera is not NaN.

    Raises InputError MAP-006 if hardly any view is filled by the map.
    """
    caster, known = RayCaster(mesh), np.flatnonzero(np.isfinite(walk).all((1, 2)))
    scale = config.focal_px / float(np.median(clip.intrinsics[:, 0, 0]))
    size = (round(clip.color_size[0] * scale), round(clip.color_size[1] * scale))
    intrinsics = cameras.scale_intrinsics(np.median(clip.intrinsics, axis=0), clip.color_size, size)

    def draw(rng: np.random.Generator) -> RenderedView:
        for _ in range(MAX_DRAWS):
            camera = views.scene_camera(walk[known], floor_m, config.pitch_deg, rng)
            view = views.render(caster, camera, intrinsics, size, rng)
            if views.plausible(view, caster):
                return view
        raise InputError(
            "MAP-006",
            f"none of {MAX_DRAWS} random views inside the map shows it in most of its pixels",
            str(clip.folder),
            "film the walk-through nearer to floor, walls and furniture, within 4 m",
        )

    def draw_query(rng: np.random.Generator) -> RenderedView:
        view = views.with_depth_noise(draw(rng), rng)
        return views.occlude(view, rng) if rng.random() < views.OCCLUDED_SHARE else view

    pictures = [draw(rng) for _ in track(range(config.views), "rendering views")]
    pictures += [
        _resized_frame(clip, int(frame), walk[frame], intrinsics, size)
        for frame in subsampling.some(known, config.frames)
    ]
    sampling = replace(SCENE_SAMPLING, focal_px=config.focal_px)
    return TrainingViews("scene", sampling, SOLVERS["scene"], pictures, draw, draw_query, config.held_out)


def agent_views(
    mesh: Mesh, config: AgentConfig, rng: np.random.Generator, skin: SkinTable | None = None
) -> TrainingViews:
    """Render random views of the agent from all sides: at rest, or in random postures if skinned."""
    at_rest = RayCaster(mesh)
    pose = None if skin is None else views.postures(mesh, skin, config.posture_deg)
    center = (mesh.vertices.min(0) + mesh.vertices.max(0)).astype(float) / 2
    radius = float(np.linalg.norm(mesh.vertices - center, axis=1).max())
    length_m, solver = body_length_m(mesh), SOLVERS["agent"]
    sampling = replace(AGENT_SAMPLING, focal_px=AGENT_SAMPLING.focal_px / length_m)
    threshold_m, min_side_m = solver.threshold_m * length_m, solver.min_side_m * length_m
    solver = replace(solver, threshold_m=threshold_m, min_side_m=min_side_m)
    focal = RENDER_SCALE * sampling.focal_px

    def draw(rng: np.random.Generator) -> RenderedView:
        camera = views.agent_camera(center, config.distance_m, rng)
        caster = at_rest if pose is None else RayCaster(pose(rng))
        distance = float(np.linalg.norm(camera[:3, 3] - center))
        size = int(np.clip(VIEW_MARGIN * radius / max(distance - radius, MIN_DISTANCE_M) * focal, *VIEW_PX))
        intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
        return views.render(caster, camera, intrinsics, (size, size), rng)

    def draw_query(rng: np.random.Generator) -> RenderedView:
        return views.with_depth_noise(draw(rng), rng)

    pictures = [draw(rng) for _ in track(range(config.views), "rendering views")]
    return TrainingViews("agent", sampling, solver, pictures, draw, draw_query, config.held_out)


def train(
    data: TrainingViews, config: Config, describer: Describer, device: str, rng: np.random.Generator
) -> tuple[localizers.Localizer, described_views.HeldOutErrors]:
    """Train on the views, then measure the error and calibrate the probability on held-out queries."""
    describe = localizers.open_describer(describer, device)
    described = described_views.describe_views(data.pictures, data.sampling, PCA_AXES, describe, rng)
    match config.kind:
        case "bank":
            model = described.bank()
        case "regression":
            draw = _fresh_patches(data, describe) if config.network.fresh_views else None
            seed = int(rng.integers(MAX_SEED))
            model = networks.train_regressor(described, data.target, config.network, seed, draw, device)
        case _:
            assert_never(config.kind)
    uncalibrated = localizers.Localizer(
        data.sampling,
        described.basis,
        model,
        localizers.Calibration(0.0, 0.0),
        data.solver,
        describer,
        describe,
    )
    held = described_views.evaluate(uncalibrated, lambda: data.draw_query(rng), data.held_out)
    return replace(uncalibrated, calibration=localizers.calibrate(held.inlier_ratio, held.good)), held


def _fresh_patches(data, describe) -> networks.DrawPatches:
    """Return a function that renders and describes a new view with enough patches."""

    def draw(rng: np.random.Generator) -> tuple[Patches, np.ndarray]:
        for _ in range(MAX_DRAWS):
            view = data.draw(rng)
            patches = described_views.describe_view(view, data.sampling, describe)
            if patches is not None:
                return patches, view.map_from_camera
        raise AssertionError("no view shows the target")

    return draw


def _resized_frame(clip, frame, world_from_camera, intrinsics, size):
    """Return one recorded frame, resized, as a view."""
    color = cv2.resize(clip.color(frame), size[::-1], interpolation=cv2.INTER_AREA)
    depth = cv2.resize(clip.depth(frame), size[::-1], interpolation=cv2.INTER_NEAREST)
    return RenderedView(world_from_camera, intrinsics, color, depth, depth > 0)
