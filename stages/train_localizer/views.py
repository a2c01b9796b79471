"""Random views of a template: camera poses, rendering, and augmentation by light, blur and noise.

`scene_camera` and `agent_camera` sample poses, `render` renders an augmented view; all use one generator.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from kornia.enhance import adjust_gamma
from kornia.filters import gaussian_blur2d

from pipeline.data.templates import SkinTable
from pipeline.fields.limbs import KinematicTree
from pipeline.fields.skinning import SkinnedShape
from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import Mesh, RayCaster, area_normals, render_view
from pipeline.mapping.depth_scans import depth_noise

UP = np.array([0.0, 1.0, 0.0])
NEAR_SHARE, NEAR_M, NEAR_YAW_RAD, NEAR_PITCH_RAD = 0.5, 0.35, 0.6, 0.2
"""Share of scene cameras near the walk-through's, standard deviations of their offset, meters and radians."""
ROOM_MARGIN_M, HEIGHT_M = 0.8, (0.5, 1.9)
"""The other cameras: margin around the walk-through's path, and heights above the floor, meters."""
ROLL_DEG = 12.0
"""Standard deviation of roll, degrees."""
ELEVATION_DEG, TARGET_SIGMA_M = (-10.0, 70.0), 0.03
"""Agent cameras: elevation range (degrees), and standard deviation of the look-at point (meters)."""
GAIN, WHITE_BALANCE, GAMMA = 0.3, 0.04, 0.25
"""Largest change of exposure, standard deviation of white balance, largest change of gamma."""
BLUR_PX, MIN_BLUR_PX, PIXEL_NOISE = 1.0, 0.3, 0.015
"""Largest and least Gaussian blur, pixels, and standard deviation of pixel noise, share of full scale."""
OCCLUDED_SHARE, OCCLUDER_DEPTH = 0.4, 0.8
"""Share of scene queries with an occluder, and its depth relative to what it hides."""
OCCLUDER_AXES, OCCLUDER_TURN_DEG = ((12, 4), (14, 7)), 30
"""Range of an occluder's semi-axes, as divisors of the picture's width, and largest rotation."""
MIN_SEEN_SHARE, MIN_DEPTH_M, DEPTH_QUANTILE, MIN_FRONT_SHARE = 0.6, 0.35, 0.05, 0.95
"""A plausible view: least share of pixels with surface, least depth (meters) at a quantile, and least share
of front-facing surface."""
FRONT_RAYS = 16
"""Rays along the picture's height that test for front faces."""


@dataclass(frozen=True)
class RenderedView:
    """One augmented rendered view; depth in meters, 0 = no surface; intrinsics in pixels."""

    map_from_camera: Float[np.ndarray, "4 4"]
    intrinsics: Float[np.ndarray, "3 3"]
    color: UInt8[np.ndarray, "height width 3"]
    depth: Float[np.ndarray, "height width"]
    seen: Bool[np.ndarray, "height width"]


def scene_camera(
    walk: Float[np.ndarray, "frame 4 4"],
    floor_m: float,
    pitch_deg: tuple[float, float],
    rng: np.random.Generator,
) -> Float[np.ndarray, "4 4"]:
    """Sample a camera near one of the walk-through's, or anywhere around its path."""
    roll = np.deg2rad(rng.normal(0, ROLL_DEG))
    near = walk[rng.integers(len(walk))]
    if rng.random() < NEAR_SHARE:
        turn = rigid.exp(np.concatenate([[rng.normal(0, NEAR_PITCH_RAD), 0, roll], np.zeros(3)]))
        yaw = rigid.rotation_from_vector(UP * rng.normal(0, NEAR_YAW_RAD))
        return rigid.make(yaw @ near[:3, :3] @ turn[:3, :3], near[:3, 3] + rng.normal(0, NEAR_M, 3))
    low, high = walk[:, :3, 3].min(0) - ROOM_MARGIN_M, walk[:, :3, 3].max(0) + ROOM_MARGIN_M
    eye = rng.uniform(low, high)
    eye[1] = floor_m + rng.uniform(*HEIGHT_M)
    yaw, pitch = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.uniform(*pitch_deg))
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    return rigid.look_at(eye, eye + forward, UP) @ rigid.exp(np.array([0, 0, roll, 0, 0, 0]))


def agent_camera(
    center: Float[np.ndarray, "3"], distance_m: tuple[float, float], rng: np.random.Generator
) -> Float[np.ndarray, "4 4"]:
    """Sample a camera that looks at the agent from any azimuth."""
    azimuth = rng.uniform(-np.pi, np.pi)
    elevation = np.arcsin(rng.uniform(*np.sin(np.deg2rad(ELEVATION_DEG))))
    direction = np.array(
        [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
    )
    eye = center + direction * rng.uniform(*distance_m)
    roll = np.deg2rad(rng.normal(0, ROLL_DEG))
    return rigid.look_at(eye, center + rng.normal(0, TARGET_SIGMA_M, 3), UP) @ rigid.exp(
        np.array([0, 0, roll, 0, 0, 0])
    )


def postures(mesh: Mesh, skin: SkinTable, posture_deg: float) -> Callable[[np.random.Generator], Mesh]:
    """Return a function that draws the agent's mesh in random postures, its root bone at rest.

    Each bone turns about its joint by a normally distributed rotation vector (degrees per axis), and what
    hangs on it follows.
    """
    rest = torch.from_numpy(skin.agent_from_bone_rest)
    shape = SkinnedShape(mesh.vertices, skin.weights, skin.agent_from_bone_rest)
    tree = KinematicTree.of(torch.from_numpy(mesh.vertices), torch.from_numpy(skin.weights), rest)

    def draw(rng: np.random.Generator) -> Mesh:
        turn = torch.from_numpy(rng.normal(0, np.deg2rad(posture_deg), (1, len(rest), 3))).float()
        posed = shape.posed((tree.motion(turn)[0] @ rest).numpy())
        return replace(mesh, vertices=posed.astype(np.float32))

    return draw


def render(
    caster: RayCaster,
    map_from_camera: Float[np.ndarray, "4 4"],
    intrinsics: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    rng: np.random.Generator,
) -> RenderedView:
    """Render a view (size = height, width in pixels) with augmented color and exact depth."""
    depth, hits = render_view(caster, map_from_camera, intrinsics, *size)
    seen = depth > 0
    assert caster.mesh.color is not None, "templates have colors"
    color = hits.interpolate(caster.mesh, caster.mesh.color).reshape(*size, 3)
    color[~seen] = color[seen].mean(0) if seen.any() else 128
    return RenderedView(map_from_camera, intrinsics, augment(color, rng), depth, seen)


def augment(
    color: Float[np.ndarray, "height width 3"], rng: np.random.Generator
) -> UInt8[np.ndarray, "height width 3"]:
    """Change exposure, white balance and gamma, blur a little and add noise; colors 0..255."""
    sigma = max(MIN_BLUR_PX, rng.uniform(0, BLUR_PX))
    kernel = round(8 * sigma + 1) | 1  # four standard deviations on either side
    gain = 1 + rng.uniform(-GAIN, GAIN) + rng.normal(0, WHITE_BALANCE, 3)
    gamma = 1 + rng.uniform(-GAMMA, GAMMA)
    picture = torch.from_numpy(color.astype(np.float32) / 255).permute(2, 0, 1)[None]
    picture = adjust_gamma(gaussian_blur2d(picture, kernel, (sigma, sigma)), gamma)
    noisy = picture[0].permute(1, 2, 0).numpy() * gain + rng.normal(0, PIXEL_NOISE, color.shape)
    return np.clip(np.round(noisy * 255), 0, 255).astype(np.uint8)


def plausible(view: RenderedView, caster: RayCaster) -> bool:
    """Return whether a person could have taken the view: mostly front-facing surface, not too near."""
    if view.seen.mean() < MIN_SEEN_SHARE or np.quantile(view.depth[view.seen], DEPTH_QUANTILE) < MIN_DEPTH_M:
        return False
    grid = view.depth.shape[0] // FRONT_RAYS
    directions = (
        cameras.ray_directions(view.intrinsics, *view.depth.shape)[::grid, ::grid].reshape(-1, 3)
        @ view.map_from_camera[:3, :3].T
    )
    face = caster.cast(view.map_from_camera[:3, 3], directions).face
    corner = caster.mesh.vertices[caster.mesh.faces[face[face >= 0]]]
    normal = area_normals(corner)
    return bool((np.einsum("ri,ri->r", normal, directions[face >= 0]) < 0).mean() > MIN_FRONT_SHARE)


def occlude(view: RenderedView, rng: np.random.Generator) -> RenderedView:
    """Add a uniform elliptic occluder, nearer than what it hides."""
    height, width = view.depth.shape
    center = (int(rng.integers(width // 5, width * 4 // 5)), int(rng.integers(height // 3, height)))
    axes = tuple(int(rng.integers(width // small, width // large)) for small, large in OCCLUDER_AXES)
    shape = np.zeros(view.depth.shape, np.uint8)
    cv2.ellipse(shape, center, axes, float(rng.uniform(-OCCLUDER_TURN_DEG, OCCLUDER_TURN_DEG)), 0, 360, 1, -1)
    color = np.where(shape[..., None] > 0, rng.integers(0, 255, 3).astype(np.uint8), view.color)
    return replace(view, color=color, depth=np.where(shape > 0, view.depth * OCCLUDER_DEPTH, view.depth))


def with_depth_noise(view: RenderedView, rng: np.random.Generator) -> RenderedView:
    """Add phone depth noise."""
    noisy = np.where(view.seen, view.depth + rng.normal(0, 1, view.depth.shape) * depth_noise(view.depth), 0)
    return replace(view, depth=noisy.astype(np.float32))
