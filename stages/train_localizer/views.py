"""Random views of a template: where cameras stand, what they would see, and how light and noise disturb it.

`scene_camera` and `agent_camera` draw poses, `photograph` renders one with noise; all draw from one generator.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.space import cameras, rigid
from pipeline.space.meshes import RayCaster, render_view
from pipeline.space.surface import depth_noise

UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class ViewOptions:
    """Where random cameras stand and how their pictures are disturbed."""

    near_share: float = 0.5
    """Share of scene cameras drawn near the walk-through's, the rest anywhere in the room."""
    near_m: float = 0.35
    """Spread of those around the walk-through's cameras, metres."""
    height_m: tuple[float, float] = (0.5, 1.9)
    """Heights above the floor of cameras drawn anywhere, metres."""
    pitch_deg: tuple[float, float] = (-55.0, 15.0)
    """Scene cameras look between these angles, degrees above the horizon."""
    roll_deg: float = 12.0
    """Standard deviation of roll, degrees."""
    distance_m: tuple[float, float] = (0.7, 3.5)
    """Distances of agent cameras, metres."""
    elevation_deg: tuple[float, float] = (-10.0, 70.0)
    """Agent cameras stand between these elevations, degrees."""
    gain: float = 0.3
    """Largest relative change of brightness."""
    gamma: float = 0.25
    """Largest relative change of gamma."""
    blur_px: float = 1.0
    """Largest Gaussian blur, pixels."""
    noise: float = 0.015
    """Standard deviation of pixel noise, share of full scale."""
    occluded: float = 0.4
    """Share of scene views with a blob in front, as the animal would be."""


@dataclass(frozen=True)
class Photograph:
    """One rendered view, disturbed as a phone would."""

    map_from_camera: Float[np.ndarray, "4 4"]
    intrinsics: Float[np.ndarray, "3 3"]
    color: UInt8[np.ndarray, "height width 3"]
    depth: Float[np.ndarray, "height width"]
    seen: Bool[np.ndarray, "height width"]


def scene_camera(
    walk: Float[np.ndarray, "frame 4 4"], floor_m: float, options: ViewOptions, rng: np.random.Generator
) -> Float[np.ndarray, "4 4"]:
    """Draw a camera: near one of the walk-through's, or anywhere within reach of where it went."""
    roll = np.deg2rad(rng.normal(0, options.roll_deg))
    near = walk[rng.integers(len(walk))]
    if rng.random() < options.near_share:
        turn = rigid.exp(np.concatenate([[rng.normal(0, 0.2), 0, roll], np.zeros(3)]))
        yaw = rigid.rotation_from_vector(UP * rng.normal(0, 0.6))
        return rigid.make(yaw @ near[:3, :3] @ turn[:3, :3], near[:3, 3] + rng.normal(0, options.near_m, 3))
    low, high = walk[:, :3, 3].min(0) - 0.8, walk[:, :3, 3].max(0) + 0.8
    eye = rng.uniform(low, high)
    eye[1] = floor_m + rng.uniform(*options.height_m)
    yaw, pitch = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.uniform(*options.pitch_deg))
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    return rigid.look_at(eye, eye + forward, UP) @ rigid.exp(np.array([0, 0, roll, 0, 0, 0]))


def agent_camera(centre: Float[np.ndarray, "3"], options: ViewOptions, rng: np.random.Generator) -> Float[np.ndarray, "4 4"]:
    """Draw a camera that looks at the agent from any azimuth."""
    azimuth = rng.uniform(-np.pi, np.pi)
    elevation = np.arcsin(rng.uniform(*np.sin(np.deg2rad(options.elevation_deg))))
    direction = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    eye = centre + direction * rng.uniform(*options.distance_m)
    roll = np.deg2rad(rng.normal(0, options.roll_deg))
    return rigid.look_at(eye, centre + rng.normal(0, 0.03, 3), UP) @ rigid.exp(np.array([0, 0, roll, 0, 0, 0]))


def photograph(
    caster: RayCaster,
    map_from_camera: Float[np.ndarray, "4 4"],
    intrinsics: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    options: ViewOptions,
    rng: np.random.Generator,
) -> Photograph:
    """Render a view and disturb its colour; depth stays exact (see `with_depth_noise`)."""
    depth, hits = render_view(caster, map_from_camera, intrinsics, *size)
    seen = depth > 0
    color = hits.interpolate(caster.mesh, caster.mesh.color).reshape(*size, 3)
    color[~seen] = color[seen].mean(0) if seen.any() else 128
    return Photograph(map_from_camera, intrinsics, disturb(color, options, rng), depth, seen)


def disturb(
    color: Float[np.ndarray, "height width 3"], options: ViewOptions, rng: np.random.Generator
) -> UInt8[np.ndarray, "height width 3"]:
    """Change exposure, white balance and gamma, blur a little, add noise."""
    picture = cv2.GaussianBlur(color.astype(np.float32) / 255, (0, 0), max(0.3, rng.uniform(0, options.blur_px)))
    gain = 1 + rng.uniform(-options.gain, options.gain) + rng.normal(0, 0.04, 3)
    picture = np.clip(picture, 1e-4, 1) ** (1 + rng.uniform(-options.gamma, options.gamma)) * gain
    picture = picture + rng.normal(0, options.noise, picture.shape)
    return np.clip(np.round(picture * 255), 0, 255).astype(np.uint8)


def plausible(view: Photograph, caster: RayCaster) -> bool:
    """Tell whether a person could have taken this scene view: mostly seen surface, from its front, nothing too near."""
    if view.seen.mean() < 0.6 or np.quantile(view.depth[view.seen], 0.05) < 0.35:
        return False
    grid = view.depth.shape[0] // 16
    directions = cameras.ray_directions(view.intrinsics, *view.depth.shape)[::grid, ::grid].reshape(-1, 3) @ view.map_from_camera[:3, :3].T
    face = caster.cast(view.map_from_camera[:3, 3], directions).face
    corner = caster.mesh.vertices[caster.mesh.faces[face[face >= 0]]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return bool((np.einsum("ri,ri->r", normal, directions[face >= 0]) < 0).mean() > 0.95)


def occlude(view: Photograph, rng: np.random.Generator) -> Photograph:
    """Put a blob of one colour in front, nearer than what it hides."""
    height, width = view.depth.shape
    centre = (int(rng.integers(width // 5, width * 4 // 5)), int(rng.integers(height // 3, height)))
    axes = (int(rng.integers(width // 12, width // 4)), int(rng.integers(width // 14, width // 7)))
    shape = np.zeros(view.depth.shape, np.uint8)
    cv2.ellipse(shape, centre, axes, float(rng.uniform(-30, 30)), 0, 360, 1, -1)
    color = np.where(shape[..., None] > 0, rng.integers(0, 255, 3).astype(np.uint8), view.color)
    return Photograph(view.map_from_camera, view.intrinsics, color, np.where(shape > 0, view.depth * 0.8, view.depth), view.seen)


def with_depth_noise(view: Photograph, rng: np.random.Generator) -> Photograph:
    """Add the noise that phone depth has."""
    noisy = np.where(view.seen, view.depth + rng.normal(0, 1, view.depth.shape) * depth_noise(view.depth), 0)
    return Photograph(view.map_from_camera, view.intrinsics, view.color, noisy.astype(np.float32), view.seen)
