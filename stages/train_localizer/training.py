"""From a template to a trained localizer: what the front calls."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import assert_never

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.errors import InputError
from pipeline.files.clips import Clip
from pipeline.models import localizer as model
from pipeline.models.sight import Sight, Target
from pipeline.progress import track
from pipeline.space import cameras
from pipeline.space.meshes import Mesh, RayCaster
from stages.train_localizer import describing, networks, views
from stages.train_localizer.networks import NetOptions
from stages.train_localizer.views import Photograph, ViewOptions

MOST_DRAWS = 200
"""Random views of the scene of which one at least must be such as people take."""


@dataclass(frozen=True)
class Options:
    """Number of views, scale of the pictures, and how queries are answered."""

    views: int = 500
    """Rendered views that are learnt."""
    held_out: int = 80
    """Further views that measure the error and calibrate the uncertainty."""
    frames: int = 60
    """Scene: frames of the walk-through that join them."""
    channels: int = 64
    """Principal axes of the descriptors that are kept."""
    focal_px: float = 120.0
    """Scene: focal length of the resized pictures, pixels; agent: pixels a metre."""
    window_px: int = 104
    """Agent: edge of the crop, pixels."""
    stride_px: int = 8
    """Distance between patches, pixels of the resized picture."""
    radii_px: tuple[int, ...] = (6, 18)
    """Radii of the concatenated DAISY descriptors, pixels of the resized picture."""
    threshold_m: float = 0.1
    """RANSAC: matches within this agree, metres."""
    spread_m: float = 0.25
    """RANSAC: least side of a triplet, metres."""
    iterations: int = 600
    """RANSAC: triplets."""
    sectors: int = 6
    """Agent: sectors of azimuth that answer separately."""
    net: NetOptions = field(default_factory=NetOptions)
    """Kinds that are networks: size and training."""
    view: ViewOptions = field(default_factory=ViewOptions)
    """Where cameras stand and how pictures are disturbed."""


@dataclass(frozen=True)
class AgentOptions(Options):
    """The same for the agent, which is small, near and seen from all around."""

    views: int = 250
    """Rendered views that are learnt."""
    held_out: int = 60
    """Further views that measure the error and calibrate the uncertainty."""
    focal_px: float = 110.0
    """Pixels a metre of the crops."""
    stride_px: int = 4
    """Distance between patches, pixels of the crop."""
    radii_px: tuple[int, ...] = (6, 14)
    """Radii of the concatenated DAISY descriptors, pixels of the crop."""
    threshold_m: float = 0.04
    """RANSAC: matches within this agree, metres."""
    spread_m: float = 0.06
    """RANSAC: least side of a triplet, metres."""


@dataclass(frozen=True)
class Shown:
    """What a localizer learns from, and where queries come from that it has not seen."""

    pictures: list[Photograph]
    draw_query: Callable[[], Photograph]


def show_scene(
    mesh: Mesh,
    walk: Float[np.ndarray, "frame 4 4"],
    floor_m: float,
    clip: Clip,
    options: Options,
    rng: np.random.Generator,
) -> Shown:
    """Render random views of the scene and add frames of the walk-through with their template cameras.

    Raises InputError MAP-006 where the map fills hardly any view.
    """
    caster = RayCaster(mesh)
    scale = options.focal_px / float(np.median(clip.intrinsics[:, 0, 0]))
    size = (round(clip.color_size[0] * scale), round(clip.color_size[1] * scale))
    intrinsics = cameras.scale_intrinsics(np.median(clip.intrinsics, axis=0), clip.color_size, size)

    def draw() -> Photograph:
        for _ in range(MOST_DRAWS):
            view = views.photograph(caster, views.scene_camera(walk, floor_m, options.view, rng), intrinsics, size, options.view, rng)
            if views.plausible(view, caster):
                return view
        what = f"none of {MOST_DRAWS} views from within the map shows it in most of its pixels"
        raise InputError("MAP-006", what, str(clip.folder), "film the walk-through nearer to floor, walls and furniture, within 4 m")

    def draw_query() -> Photograph:
        view = views.with_depth_noise(draw(), rng)
        return views.occlude(view, rng) if rng.random() < options.view.occluded else view

    pictures = [draw() for _ in track(range(options.views), "rendering views")]
    chosen = np.unique(np.linspace(0, len(clip) - 1, options.frames).astype(int)) if options.frames else []
    return Shown(pictures + [_frame(clip, int(frame), walk[frame], intrinsics, size) for frame in chosen], draw_query)


def train_scene(
    mesh: Mesh,
    walk: Float[np.ndarray, "frame 4 4"],
    floor_m: float,
    clip: Clip,
    options: Options,
    rng: np.random.Generator,
    kind: model.Kind = "bank",
) -> tuple[model.Localizer, describing.HeldOut]:
    """Train on random views of the scene and on frames of the walk-through with their template cameras."""
    return train(show_scene(mesh, walk, floor_m, clip, options, rng), options, kind, "scene", rng)


def train_agent(
    mesh: Mesh, options: Options, rng: np.random.Generator, kind: model.Kind = "bank"
) -> tuple[model.Localizer, describing.HeldOut]:
    """Train on random views of the canonical agent, from all around."""
    caster = RayCaster(mesh)
    centre = (mesh.vertices.min(0) + mesh.vertices.max(0)).astype(float) / 2
    reach = float(np.linalg.norm(mesh.vertices - centre, axis=1).max())

    def draw() -> Photograph:
        camera = views.agent_camera(centre, options.view, rng)
        away = float(np.linalg.norm(camera[:3, 3] - centre))
        size = int(np.clip(2.4 * reach / max(away - reach, 0.3) * 2 * options.focal_px, 64, 240))
        intrinsics = np.array([[2 * options.focal_px, 0, size / 2], [0, 2 * options.focal_px, size / 2], [0, 0, 1.0]])
        return views.photograph(caster, camera, intrinsics, (size, size), options.view, rng)

    pictures = [draw() for _ in track(range(options.views), "rendering views")]
    return train(Shown(pictures, lambda: views.with_depth_noise(draw(), rng)), options, kind, "agent", rng)


def train(
    shown: Shown, options: Options, kind: model.Kind, target: Target, rng: np.random.Generator
) -> tuple[model.Localizer, describing.HeldOut]:
    """Learn what is shown, measure the error on fresh queries and calibrate the uncertainty with it."""
    sight = Sight(target, options.focal_px, options.window_px, options.stride_px, options.radii_px)
    described = describing.describe_views(shown.pictures, sight, options.channels, rng)
    match kind:
        case "bank":
            made = described.bank()
        case "coordinates":
            made = networks.train_coordinates(described, options.net, int(rng.integers(2**31)))
        case "regression":
            made = networks.train_regressor(described, target, options.net, int(rng.integers(2**31)))
        case _:
            assert_never(kind)
    solver = model.Solver(options.threshold_m, options.spread_m, options.iterations, options.sectors)
    unsure = model.Localizer(sight, described.basis, made, model.Calibration(0.0, 0.0), solver)
    held = describing.hold_out(unsure, shown.draw_query, options.held_out)
    return replace(unsure, calibration=model.calibrate(held.inlier_ratio, held.good)), held


def _frame(clip, frame, world_from_camera, intrinsics, size):
    """Bring one real frame to the bank's size, as if it had been rendered."""
    color = cv2.resize(clip.color(frame), size[::-1], interpolation=cv2.INTER_AREA)
    depth = cv2.resize(clip.depth(frame), size[::-1], interpolation=cv2.INTER_NEAREST)
    return Photograph(world_from_camera, intrinsics, color, depth, depth > 0)
