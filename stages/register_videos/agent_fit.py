"""Fit the animal's canonical surface to the depth inside its mask: many headings at once, rigidly and
upright.

`observe` lifts the masked depth to the world, `fit_coarse` and `fit_fine` run a robust point-to-plane fit
from every initial pose in one batch, `cost` scores a pose.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import KDTree

from pipeline.data.clips import Clip
from pipeline.geometry import cameras, contact, rigid, subsampling
from pipeline.geometry.meshes import Mesh, RayCaster

UP = np.array([0.0, 1.0, 0.0])
POINTS, MODEL_POINTS = 220, 700
"""Depth points per frame and vertices of the template that are used; more fit no better."""
LEAF_POINTS = 32
"""Vertices in a leaf of the search tree; nearest ones are found fastest so."""
COARSE_ROUNDS, FIRST_REACH_M, REACH_M = 5, 0.18, 0.07
"""Gauss-Newton steps from every initial pose, and width of the robust weight at first and at the end, metres:
legs and tail move, the trunk decides."""
TILT_SIGMA_RAD, UPRIGHT_SIGMA_RAD = float(np.deg2rad(15.0)), 1e-4
"""Standard deviation of the root's tilt against upright where it may lean, and where it may not, radians."""
STAND_POINTS, STAND_REACH_M, STAND_COST_M = 40.0, 0.12, 0.012
"""Standing on the surface below counts as so many depth points, with a robust weight of this width (animals
jump and lie down), and floating or sinking by more costs this much, metres."""
COLOR_WEIGHT_M, OUTSIDE_WEIGHT_M, TRUNCATION = 0.06, 0.05, 1.5
"""Cost of a full-scale colour difference and of a template wholly outside the mask, metres; distances are
truncated at so many reaches."""
POINT_SHARE = 0.15
"""Weight of the point-to-point term against point-to-plane, so that nothing slides away."""
PRIOR_POINTS, POINT_SIGMA_M, DAMPING = 20, 0.03, 1e-6
"""Points that the prior of upright counts as, their noise (metres), and damping of a step."""
PREDICTED_POINTS, LEAVING_COST_M = 40, 0.002
"""Points that a predicted pose counts as, and cost of leaving it by one standard deviation, metres."""
MIN_POINTS, MIN_ERODED_PX, NEAREST_M = 25, 60, 0.1
"""Depth points that an observation needs, pixels that the eroded mask keeps, least depth (metres)."""
RADIUS, FULL_VIEW, DEPTH_SHARE = 0.75, 0.3, 0.1
"""In body lengths: radius around the median that points must lie in, silhouette area in full view (squared),
and distance from the seen side to the middle."""
BACK_QUANTILE = 0.8
"""Quantile of the template's heights that is its back's: head and tail rise above."""
STANDING_STEP = 8
"""One point in so many measures the surface below."""
BEHIND_M = 0.05
"""Depth looks past the template when it is farther by this, metres."""


@dataclass(frozen=True)
class AgentModel:
    """The template, subsampled: points, normals and colours in the agent frame, with a search tree."""

    points_agent: Float[np.ndarray, "point 3"]
    normals_agent: Float[np.ndarray, "point 3"]
    color: Float[np.ndarray, "point 3"]
    """0..1"""
    tree: KDTree
    length_m: float
    """Horizontal length."""
    stand_m: float
    """Height of the root above the paws."""


@dataclass(frozen=True)
class StandingSurface:
    """What animals stand on: the scene's surface, and the floor where it has holes."""

    caster: RayCaster
    floor_m: float

    def below(self, points_world: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point"]:
        """Return the height of the first surface under each point, the floor's where there is none."""
        hits = self.caster.cast(points_world, np.broadcast_to([0.0, -1.0, 0.0], points_world.shape))
        return np.where(hits.face >= 0, points_world[:, 1] - hits.distance, self.floor_m)


@dataclass(frozen=True)
class AgentObservation:
    """What one frame shows of the animal; metres, colours 0..1."""

    frame: int
    points_world: Float[np.ndarray, "point 3"]
    color: Float[np.ndarray, "point 3"]
    mask: Bool[np.ndarray, "height width"]
    depth: Float[np.ndarray, "depth_height depth_width"]
    world_from_camera: Float[np.ndarray, "4 4"]
    intrinsics: Float[np.ndarray, "3 3"]
    standing_m: float
    """Height at which the root would be if the animal stood on what lies below it; NaN where nothing does."""
    share: float
    """Visible area over the area that the body would fill at this distance; 1 is in full view."""


def make_model(mesh: Mesh, rng: np.random.Generator) -> AgentModel:
    """Subsample the template evenly by area."""
    weight = np.bincount(mesh.faces.ravel(), np.repeat(mesh.face_areas(), 3), len(mesh.vertices))
    count = min(MODEL_POINTS, (weight > 0).sum())
    chosen = np.sort(rng.choice(len(mesh.vertices), count, replace=False, p=weight / weight.sum()))
    points = mesh.vertices[chosen].astype(float)
    color = np.full((len(chosen), 3), 0.5) if mesh.color is None else mesh.color[chosen] / 255.0
    extent = np.ptp(points[:, [0, 2]], axis=0)
    stand_m, normals = float(-np.quantile(points[:, 1], 0.01)), mesh.vertex_normals()[chosen]
    return AgentModel(points, normals, color, KDTree(points, LEAF_POINTS), float(extent.max()), stand_m)


def observe(
    clip: Clip,
    mask: UInt8[np.ndarray, "height width"],
    frame: int,
    world_from_camera: Float[np.ndarray, "4 4"],
    model: AgentModel,
    standing: StandingSurface,
) -> AgentObservation | None:
    """Lift the masked depth to the world, without the mask's rim and without what lies far from the rest;
    None if too little is left."""
    inside = mask == 255
    depth = clip.depth(frame)
    small = cv2.resize(inside.astype(np.uint8), depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
    if clip.mapped:
        depth = _standing_depth(
            depth, small > 0, clip.depth_intrinsics[frame], world_from_camera, model, standing
        )
    eroded = cv2.erode(small, np.ones((3, 3), np.uint8))
    chosen = np.flatnonzero(
        ((eroded if eroded.sum() > MIN_ERODED_PX else small) > 0)
        & (depth > NEAREST_M)
        & (clip.mapped | (clip.confidence(frame) >= 1))
    )
    if len(chosen) < MIN_POINTS:
        return None
    points = cameras.back_project(depth, clip.depth_intrinsics[frame]).reshape(-1, 3)[chosen]
    near = np.linalg.norm(points - np.median(points, axis=0), axis=1) < RADIUS * model.length_m
    if near.sum() < MIN_POINTS:
        return None
    points = points[near][subsampling.evenly(near.sum(), POINTS)]
    pixel, z = cameras.project(points, clip.intrinsics[frame])
    limit = np.array(mask.shape[::-1]) - 1
    column, row = np.clip(pixel.astype(int), 0, limit).T
    full_px = FULL_VIEW * model.length_m**2 * (clip.intrinsics[frame, 0, 0] / np.median(z)) ** 2
    points_world = rigid.apply(world_from_camera, points)
    inner = points_world[::STANDING_STEP] + _behind(points_world, world_from_camera[:3, 3], model)
    return AgentObservation(
        frame=frame,
        points_world=points_world,
        color=clip.color(frame)[row, column] / 255.0,
        mask=inside,
        depth=depth,
        world_from_camera=world_from_camera,
        intrinsics=clip.intrinsics[frame],
        standing_m=float(np.median(standing.below(inner))) + model.stand_m,
        share=float(min(1.0, inside.sum() / full_px)),
    )


def _standing_depth(
    inferred: Float[np.ndarray, "height width"],
    inside: Bool[np.ndarray, "height width"],
    intrinsics: Float[np.ndarray, "3 3"],
    world_from_camera: Float[np.ndarray, "4 4"],
    model: AgentModel,
    standing: StandingSurface,
) -> Float[np.ndarray, "height width"]:
    """Return depth with that of an animal that no sensor measured: where its mask's lowest pixels touch the
    map; what was inferred before it was segmented where they touch nothing level.

    Beside the mask it stays as it is: the template must not stand where the picture shows the room.
    """
    touched = contact.find(inside, intrinsics, world_from_camera, standing.caster)
    if touched is None or not touched.certain:
        return inferred
    back_m = model.stand_m + float(np.quantile(model.points_agent[:, 1], BACK_QUANTILE))
    own = contact.depth_of(inside, touched.point_world, back_m, intrinsics, world_from_camera)
    return np.where(inside, own, inferred)


def initial_poses(
    observation: AgentObservation, model: AgentModel, headings: int
) -> Float[np.ndarray, "pose 4 4"]:
    """Return upright poses at even headings, a little behind the middle of what was seen."""
    yaw = 2 * np.pi * np.arange(headings) / headings
    rotation = rigid.rotation_from_yaw(yaw)
    middle = np.median(observation.points_world, axis=0)
    middle = middle + _behind(observation.points_world, observation.world_from_camera[:3, 3], model)
    return rigid.make(rotation, middle - rotation @ np.median(model.points_agent, axis=0))


def _behind(points_world, eye, model):
    """Return the horizontal step from the seen side of the body to its middle."""
    away = (np.median(points_world, axis=0) - eye) * (1, 0, 1)
    return DEPTH_SHARE * model.length_m * away / max(np.linalg.norm(away), 1e-6)


def fit_coarse(
    observation: AgentObservation, model: AgentModel, world_from_agent: Float[np.ndarray, "pose 4 4"]
) -> Float[np.ndarray, "pose 4 4"]:
    """Fit upright from every pose, the robust weight narrowing from wide."""
    reach = np.geomspace(FIRST_REACH_M, REACH_M, COARSE_ROUNDS)
    return _fit(observation, model, world_from_agent, reach, UPRIGHT_SIGMA_RAD)


def fit_fine(
    observation: AgentObservation,
    model: AgentModel,
    world_from_agent: Float[np.ndarray, "pose 4 4"],
    *,
    rounds: int,
    tilt: bool,
) -> Float[np.ndarray, "pose 4 4"]:
    """Fit to convergence, standing on what is below and, since animals lie down and jump, wherever depth
    says; return what costs less. With ``tilt`` the root may lean."""
    reach, prior = np.full(rounds, REACH_M), TILT_SIGMA_RAD if tilt else UPRIGHT_SIGMA_RAD
    standing, free = (
        _fit(observation, model, world_from_agent, reach, prior, stands=stands) for stands in (True, False)
    )
    better = cost(observation, model, free) < cost(observation, model, standing)
    return np.where(better[:, None, None], free, standing)


@dataclass(frozen=True)
class PosePrior:
    """A Gaussian around a predicted pose."""

    world_from_agent: Float[np.ndarray, "4 4"]
    sigma: tuple[float, float]
    """Standard deviations of rotation and position, radians and metres."""

    def twist(self, world_from_agent: Float[np.ndarray, "pose 4 4"]) -> Float[np.ndarray, "pose 6"]:
        """Return how far poses are from the predicted one, in standard deviations."""
        offset = rigid.log(rigid.inverse(self.world_from_agent) @ world_from_agent)
        return offset / np.repeat(self.sigma, 3)

    def add(
        self,
        curvature: Float[np.ndarray, "pose 6 6"],
        gradient: Float[np.ndarray, "pose 6"],
        world_from_agent: Float[np.ndarray, "pose 4 4"],
    ) -> tuple[Float[np.ndarray, "pose 6 6"], Float[np.ndarray, "pose 6"]]:
        """Add the prior to normal equations, to first order in the offset."""
        strength = PREDICTED_POINTS * POINT_SIGMA_M**2 / np.repeat(self.sigma, 3)
        curvature[:, range(6), range(6)] += strength / np.repeat(self.sigma, 3)
        return curvature, gradient + strength * self.twist(world_from_agent)


@dataclass(frozen=True)
class PriorFit:
    """A pose fitted under a prior."""

    world_from_agent: Float[np.ndarray, "4 4"]
    cost_m: float
    """`cost` of the pose, metres."""
    total_m: float
    """The same with the cost of leaving the prediction."""


def fit_near(observation: AgentObservation, model: AgentModel, prior: PosePrior, *, rounds: int) -> PriorFit:
    """Fit from a predicted pose, standing or not, whichever costs less."""
    reach, start = np.full(rounds, REACH_M), prior.world_from_agent[None]
    fits = (
        _fit(observation, model, start, reach, TILT_SIGMA_RAD, stands=stands, near=prior)
        for stands in (True, False)
    )
    poses = np.concatenate(list(fits))
    own = cost(observation, model, poses)
    total = own + LEAVING_COST_M * (prior.twist(poses) ** 2).sum(-1)
    best = int(total.argmin())
    return PriorFit(poses[best], float(own[best]), float(total[best]))


def _fit(observation, model, world_from_agent, reaches, prior, *, stands=True, near=None):
    """Step robustly, point to plane, with a little point to point so that nothing slides away."""
    placed = np.array(world_from_agent, float)
    for reach in reaches:
        local = rigid.apply(rigid.inverse(placed), observation.points_world[None])
        distance, nearest = model.tree.query(local)
        target, normal = model.points_agent[nearest], model.normals_agent[nearest]
        weight = (reach**2 / (reach**2 + distance**2)) ** 2
        gradient, curvature = _normal_equations(local, target, normal, weight)
        curvature, gradient = _keep_upright(placed, curvature, gradient, prior)
        if near is not None:
            curvature, gradient = near.add(curvature, gradient, placed)
        if stands and np.isfinite(observation.standing_m):
            curvature, gradient = _keep_standing(placed, curvature, gradient, observation.standing_m)
        placed = placed @ rigid.exp(np.linalg.solve(curvature, -gradient[..., None])[..., 0])
    return placed


def _normal_equations(local, target, normal, weight):
    """Sum plane and point terms; the twist moves the body, so it moves points the other way.

    Point terms are plane terms along the three axes, whose sums have closed forms.
    """
    gap, share, eye = local - target, POINT_SHARE * weight[..., None], np.eye(3)
    jacobian = np.concatenate([np.cross(local, normal), normal], axis=-1)
    scaled, heavy = (np.swapaxes(each, 1, 2) for each in (jacobian * weight[..., None], local * share))
    curvature, gradient = scaled @ jacobian, -(scaled @ (gap * normal).sum(-1, keepdims=True))[..., 0]
    squared, pull, lever = heavy @ local, heavy @ gap, np.cross(heavy.sum(-1)[:, None], eye)
    diagonal = np.trace(squared, axis1=1, axis2=2)[:, None, None] * eye - squared, share.sum(1)[:, None] * eye
    curvature += np.block([[diagonal[0], np.swapaxes(lever, 1, 2)], [lever, diagonal[1]]])
    turn = [pull[:, k - 2, k - 1] - pull[:, k - 1, k - 2] for k in range(3)]
    return gradient - np.stack([*turn, *(share * gap).sum(1).T], axis=-1), curvature


def _keep_upright(placed, curvature, gradient, prior_rad):
    """Add the prior that the body's up is the world's: its tilt about the body's x and z axes is small."""
    up_agent = np.einsum("sji,j->si", placed[:, :3, :3], UP)
    strength = PRIOR_POINTS * (POINT_SIGMA_M / prior_rad) ** 2
    tilt = np.cross(UP, up_agent)
    for axis in (0, 2):
        curvature[:, axis, axis] += strength
        gradient[:, axis] -= strength * tilt[:, axis]
    curvature[:, range(6), range(6)] += DAMPING
    return curvature, gradient


def _keep_standing(placed, curvature, gradient, standing_m):
    """Add the prior that the animal stands on what lies below it; robust, since it jumps and lies down."""
    height = placed[:, 1, 3] - standing_m
    weight = STAND_POINTS * (STAND_REACH_M**2 / (STAND_REACH_M**2 + height**2)) ** 2
    direction = placed[:, 1, :3]
    curvature[:, 3:, 3:] += weight[:, None, None] * direction[:, :, None] * direction[:, None, :]
    gradient[:, 3:] += (weight * height)[:, None] * direction
    return curvature, gradient


def cost(
    observation: AgentObservation, model: AgentModel, world_from_agent: Float[np.ndarray, "pose 4 4"]
) -> Float[np.ndarray, "pose"]:
    """Return each pose's cost, metres: truncated distance, colour difference, template outside the mask."""
    local = rigid.apply(rigid.inverse(world_from_agent), observation.points_world[None])
    distance, nearest = model.tree.query(local)
    seen, expected = observation.color - observation.color.mean(0), model.color[nearest]
    shade = np.abs(seen - (expected - expected.mean(1, keepdims=True))).mean((1, 2))
    height = np.nan_to_num(world_from_agent[:, 1, 3] - observation.standing_m)
    lifted = height**2 / (height**2 + STAND_REACH_M**2)
    geometry = np.minimum(distance, TRUNCATION * REACH_M).mean(1) + STAND_COST_M * lifted
    outside = _outside(observation, model, world_from_agent)
    return geometry + COLOR_WEIGHT_M * shade + OUTSIDE_WEIGHT_M * outside


def _outside(observation, model, world_from_agent):
    """Return the share of the camera-facing template that lies outside the mask while depth looks past it."""
    camera_from_agent = rigid.inverse(observation.world_from_camera) @ world_from_agent
    points = rigid.apply(camera_from_agent, model.points_agent[None])
    normals = model.normals_agent @ np.swapaxes(camera_from_agent[:, :3, :3], 1, 2)
    facing = (normals * points).sum(-1) < 0
    pixel, z = cameras.project(points, observation.intrinsics)
    height, width = observation.mask.shape
    inside = (pixel >= 0).all(-1) & (pixel[..., 0] < width) & (pixel[..., 1] < height) & (z > NEAREST_M)
    column = np.clip(pixel[..., 0], 0, width - 1).astype(int)
    row = np.clip(pixel[..., 1], 0, height - 1).astype(int)
    scale = np.array(observation.depth.shape) / (height, width)
    behind = observation.depth[(row * scale[0]).astype(int), (column * scale[1]).astype(int)] > z + BEHIND_M
    wrong = facing & inside & ~observation.mask[row, column] & behind
    return wrong.sum(1) / np.maximum(facing.sum(1), 1)
