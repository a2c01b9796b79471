"""Fit the animal's canonical surface to the depth inside its mask: many headings at once, rigidly and upright.

`observe` lifts the masked depth to the world, `fit` runs a robust point-to-plane fit from every start
in one batch, and `cost` says how badly a placement explains what was seen.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import cKDTree

from pipeline.files.clips import Clip
from pipeline.space import cameras, rigid
from pipeline.space.meshes import Mesh, RayCaster

UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class FitOptions:
    """How the body is fitted."""

    points: int = 220
    """Depth points of the animal that are used per frame."""
    model_points: int = 700
    """Vertices of the template that are used."""
    headings: int = 12
    """Headings tried from scratch in every frame."""
    coarse_rounds: int = 5
    """Gauss-Newton steps from every start ..."""
    fine_rounds: int = 12
    """... and from those that are kept."""
    reach_m: float = 0.07
    """Width of the robust weight at the end, metres: legs and tail move, the trunk decides."""
    first_reach_m: float = 0.18
    """Width at the beginning of the coarse steps, metres."""
    tilt_sigma_deg: float = 15.0
    """Standard deviation of the root's tilt against upright, degrees."""
    stand_points: float = 40.0
    """Standing on what lies below counts as much as so many depth points ..."""
    stand_reach_m: float = 0.12
    """... with a robust weight of this width, metres: animals jump and lie down."""
    stand_cost_m: float = 0.012
    """Cost in metres of floating or sinking by more than that."""
    color_weight_m: float = 0.06
    """Cost in metres of a full-scale difference of colour."""
    outside_weight_m: float = 0.05
    """Cost in metres when the whole visible template falls outside the mask."""


@dataclass(frozen=True)
class Body:
    """The template, thinned: points, normals and colours in the agent frame, with a search tree."""

    points_agent: Float[np.ndarray, "point 3"]
    normals_agent: Float[np.ndarray, "point 3"]
    color: Float[np.ndarray, "point 3"]
    """0..1"""
    tree: cKDTree
    length_m: float
    """Horizontal length."""
    stand_m: float
    """Height of the root above the paws."""


@dataclass(frozen=True)
class Ground:
    """What animals stand on: the scene's surface, and the floor where that has holes."""

    caster: RayCaster
    floor_m: float

    def below(self, points_world: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point"]:
        """Return the height of the first surface under each point, the floor's where there is none."""
        hits = self.caster.cast(points_world, np.broadcast_to([0.0, -1.0, 0.0], points_world.shape))
        return np.where(hits.face >= 0, points_world[:, 1] - hits.distance, self.floor_m)


@dataclass(frozen=True)
class Glimpse:
    """What one frame shows of the animal."""

    frame: int
    points_world: Float[np.ndarray, "point 3"]
    color: Float[np.ndarray, "point 3"]
    mask: Bool[np.ndarray, "height width"]
    depth: Float[np.ndarray, "depth_height depth_width"]
    world_from_camera: Float[np.ndarray, "4 4"]
    intrinsics: Float[np.ndarray, "3 3"]
    rest_m: float
    """Height at which the root would be if the animal stood on what lies below it; NaN where nothing does."""
    share: float
    """Visible area over the area that the body would fill at this distance; 1 is in full view."""


def make_body(mesh: Mesh, options: FitOptions, rng: np.random.Generator) -> Body:
    """Thin the template evenly."""
    normals = mesh.vertex_normals()
    corner = mesh.vertices[mesh.faces].astype(float)
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    weight = np.bincount(mesh.faces.ravel(), np.repeat(area, 3), len(mesh.vertices))
    chosen = np.sort(rng.choice(len(mesh.vertices), min(options.model_points, (weight > 0).sum()), replace=False, p=weight / weight.sum()))
    points = mesh.vertices[chosen].astype(float)
    color = np.full((len(chosen), 3), 0.5) if mesh.color is None else mesh.color[chosen] / 255.0
    extent = np.ptp(points[:, [0, 2]], axis=0)
    return Body(points, normals[chosen], color, cKDTree(points), float(extent.max()), float(-np.quantile(points[:, 1], 0.01)))


def observe(
    clip: Clip,
    mask: UInt8[np.ndarray, "height width"],
    frame: int,
    world_from_camera: Float[np.ndarray, "4 4"],
    body: Body,
    ground: Ground,
    options: FitOptions,
) -> Glimpse | None:
    """Lift the masked depth to the world, without the mask's rim and without what lies far from the rest; None if too
    little is left.
    """
    inside = mask == 255
    depth = clip.depth(frame)
    small = cv2.resize(inside.astype(np.uint8), depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
    eroded = cv2.erode(small, np.ones((3, 3), np.uint8))
    chosen = np.flatnonzero(((eroded if eroded.sum() > 60 else small) > 0) & (depth > 0.1) & (clip.confidence(frame) >= 1))
    if len(chosen) < 25:
        return None
    points = cameras.back_project(depth, clip.depth_intrinsics[frame]).reshape(-1, 3)[chosen]
    near = np.linalg.norm(points - np.median(points, axis=0), axis=1) < 0.75 * body.length_m
    if near.sum() < 25:
        return None
    points = points[near]
    points = points[np.linspace(0, len(points) - 1, min(options.points, len(points))).astype(int)]
    pixel, z = cameras.project(points, clip.intrinsics[frame])
    limit = np.array(mask.shape[::-1]) - 1
    column, row = np.clip(pixel.astype(int), 0, limit).T
    full_px = 0.3 * body.length_m**2 * (clip.intrinsics[frame, 0, 0] / np.median(z)) ** 2
    points_world = rigid.apply(world_from_camera, points)
    inner = points_world[::8] + _behind(points_world, world_from_camera[:3, 3], body)
    return Glimpse(
        frame=frame,
        points_world=points_world,
        color=clip.color(frame)[row, column] / 255.0,
        mask=inside,
        depth=depth,
        world_from_camera=world_from_camera,
        intrinsics=clip.intrinsics[frame],
        rest_m=float(np.median(ground.below(inner))) + body.stand_m,
        share=float(min(1.0, inside.sum() / full_px)),
    )


def starts(glimpse: Glimpse, body: Body, headings: int) -> Float[np.ndarray, "start 4 4"]:
    """Return upright placements at even headings, a little behind the middle of what was seen."""
    yaw = 2 * np.pi * np.arange(headings) / headings
    rotation = rigid.rotation_from_vector(yaw[:, None] * UP)
    middle = np.median(glimpse.points_world, axis=0)
    middle = middle + _behind(glimpse.points_world, glimpse.world_from_camera[:3, 3], body)
    return rigid.make(rotation, middle - rotation @ np.median(body.points_agent, axis=0))


def _behind(points_world, eye, body):
    """Return the horizontal step from the seen side of the body to its middle."""
    away = (np.median(points_world, axis=0) - eye) * (1, 0, 1)
    return 0.1 * body.length_m * away / max(np.linalg.norm(away), 1e-6)


def fit_coarse(
    glimpse: Glimpse, body: Body, world_from_agent: Float[np.ndarray, "start 4 4"], options: FitOptions
) -> Float[np.ndarray, "start 4 4"]:
    """Fit upright from every start, with a weight that narrows from wide."""
    reach = np.geomspace(options.first_reach_m, options.reach_m, options.coarse_rounds)
    return _fit(glimpse, body, world_from_agent, options, reach, 1e-4)


def fit_fine(
    glimpse: Glimpse, body: Body, world_from_agent: Float[np.ndarray, "start 4 4"], options: FitOptions, *, tilt: bool
) -> Float[np.ndarray, "start 4 4"]:
    """Fit to the end; with ``tilt`` the root may lean."""
    reach = np.full(options.fine_rounds, options.reach_m)
    return _fit(glimpse, body, world_from_agent, options, reach, np.deg2rad(options.tilt_sigma_deg) if tilt else 1e-4)


def _fit(glimpse, body, world_from_agent, options, reaches, prior):
    """Step robustly, point to plane, with a little point to point so that nothing slides away."""
    placed = np.array(world_from_agent, float)
    for reach in reaches:
        local = rigid.apply(rigid.inverse(placed), glimpse.points_world[None])
        distance, nearest = body.tree.query(local)
        target, normal = body.points_agent[nearest], body.normals_agent[nearest]
        weight = (reach**2 / (reach**2 + distance**2)) ** 2
        gradient, curvature = _normal_equations(local, target, normal, weight)
        curvature, gradient = _keep_upright(placed, curvature, gradient, prior)
        if np.isfinite(glimpse.rest_m):
            curvature, gradient = _keep_standing(placed, curvature, gradient, glimpse.rest_m, options)
        placed = placed @ rigid.exp(np.linalg.solve(curvature, -gradient[..., None])[..., 0])
    return placed


def _normal_equations(local, target, normal, weight, point_share=0.15):
    """Sum plane and point terms over the points; the twist moves the body, so it moves points the other way."""
    gap = local - target
    curvature, gradient = 0.0, 0.0
    for direction, share in [(normal, 1.0)] + [(np.broadcast_to(axis, gap.shape), point_share) for axis in np.eye(3)]:
        jacobian = -np.concatenate([np.cross(local, direction), direction], axis=-1)
        residual = (gap * direction).sum(-1)
        scaled = jacobian * (share * weight)[..., None]
        curvature = curvature + np.swapaxes(scaled, -1, -2) @ jacobian
        gradient = gradient + (scaled * residual[..., None]).sum(-2)
    return gradient, curvature


def _keep_upright(placed, curvature, gradient, prior_rad, point_sigma_m=0.03):
    """Add the prior that the body's up is the world's: its tilt about the body's x and z axes is small."""
    up_agent = np.einsum("sji,j->si", placed[:, :3, :3], UP)
    strength = (point_sigma_m / prior_rad) ** 2 * 20
    tilt = np.cross(UP, up_agent)
    for axis in (0, 2):
        curvature[:, axis, axis] += strength
        gradient[:, axis] -= strength * tilt[:, axis]
    curvature[:, range(6), range(6)] += 1e-6
    return curvature, gradient


def _keep_standing(placed, curvature, gradient, rest_m, options):
    """Add the prior that the animal stands on what lies below it; robust, since it jumps and lies down."""
    height = placed[:, 1, 3] - rest_m
    weight = options.stand_points * (options.stand_reach_m**2 / (options.stand_reach_m**2 + height**2)) ** 2
    direction = placed[:, 1, :3]
    curvature[:, 3:, 3:] += weight[:, None, None] * direction[:, :, None] * direction[:, None, :]
    gradient[:, 3:] += (weight * height)[:, None] * direction
    return curvature, gradient


def cost(glimpse: Glimpse, body: Body, world_from_agent: Float[np.ndarray, "start 4 4"], options: FitOptions) -> Float[np.ndarray, "start"]:
    """Return metres: truncated distance of the seen points, difference of colour there, and template outside the
    mask.
    """
    local = rigid.apply(rigid.inverse(world_from_agent), glimpse.points_world[None])
    distance, nearest = body.tree.query(local)
    seen, model = glimpse.color - glimpse.color.mean(0), body.color[nearest]
    shade = np.abs(seen - (model - model.mean(1, keepdims=True))).mean((1, 2))
    geometry = np.minimum(distance, 1.5 * options.reach_m).mean(1)
    height = np.nan_to_num(world_from_agent[:, 1, 3] - glimpse.rest_m)
    lifted = height**2 / (height**2 + options.stand_reach_m**2)
    geometry = geometry + options.stand_cost_m * lifted
    return geometry + options.color_weight_m * shade + options.outside_weight_m * _outside(glimpse, body, world_from_agent)


def _outside(glimpse, body, world_from_agent):
    """Return the share of the camera-facing template that should be seen, but where the mask has no animal and depth
    looks past it.
    """
    camera_from_agent = rigid.inverse(glimpse.world_from_camera) @ world_from_agent
    points = rigid.apply(camera_from_agent, body.points_agent[None])
    normals = body.normals_agent @ np.swapaxes(camera_from_agent[:, :3, :3], 1, 2)
    facing = (normals * points).sum(-1) < 0
    pixel, z = cameras.project(points, glimpse.intrinsics)
    height, width = glimpse.mask.shape
    inside = (pixel >= 0).all(-1) & (pixel[..., 0] < width) & (pixel[..., 1] < height) & (z > 0.1)
    column, row = np.clip(pixel[..., 0], 0, width - 1).astype(int), np.clip(pixel[..., 1], 0, height - 1).astype(int)
    scale = np.array(glimpse.depth.shape) / (height, width)
    behind = glimpse.depth[(row * scale[0]).astype(int), (column * scale[1]).astype(int)] > z + 0.05
    wrong = facing & inside & ~glimpse.mask[row, column] & behind
    return wrong.sum(1) / np.maximum(facing.sum(1), 1)
