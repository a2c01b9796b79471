"""Fit the animal's canonical surface rigidly to the depth inside its mask, from many headings at once.

`observe` back-projects the masked depth to the world, `fit_coarse` and `fit_fine` run robust point-to-plane
ICP from all initial poses in one batch, `cost` scores poses. Distances of the body are in body lengths.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import KDTree

from pipeline.data.clips import Clip
from pipeline.geometry import cameras, contact, picture_fit, rigid, subsampling
from pipeline.geometry.contact import StandingSurface
from pipeline.geometry.meshes import Mesh
from pipeline.geometry.picture_fit import BodyPicture, ColoredBody
from pipeline.geometry.size import body_length_m

UP = np.array([0.0, 1.0, 0.0])
POINTS, MODEL_POINTS = 220, 700
"""Depth points per frame, and vertices sampled from the template; more do not improve the fit."""
LEAF_POINTS = 32
"""Leaf size of the k-d tree, the fastest here."""
COARSE_ROUNDS, FIRST_REACH, REACH = 5, 0.3, 0.117
"""Gauss-Newton steps from every initial pose, and initial and final width of the robust kernel, body lengths,
which rejects moving legs and tail."""
TILT_SIGMA_RAD, UPRIGHT_SIGMA_RAD = float(np.deg2rad(15.0)), 1e-4
"""Prior standard deviation of the root's tilt, if it may tilt and if it must stay upright, radians."""
STAND_POINTS, STAND_REACH, STAND_COST = 40.0, 0.2, 0.02
"""Prior that the animal stands on the surface below: equivalent depth points, width of its robust
kernel (animals jump and lie down), and largest cost, body lengths."""
COLOR_WEIGHT, OUTSIDE_WEIGHT, TRUNCATION = 0.1, 0.0833, 1.5
"""Cost of a full-scale color difference, and of a template wholly outside the mask, body lengths; truncation
of distances, in reaches."""
PICTURE_COST, CONTACT_WEIGHT, TILT_COST = 0.0533, 0.2, 0.00333
"""Without measured depth: cost of a typical picture (body lengths), weight of distances from the box that
stands at the contact point, which has no head and no legs, and cost of a tilt by one sigma (body lengths)."""
POINT_WEIGHT = 0.15
"""Weight of the point-to-point term relative to point-to-plane; prevents sliding."""
PRIOR_POINTS, POINT_SIGMA, DAMPING = 20, 0.05, 1e-6
"""Equivalent points of the upright prior, their noise (body lengths, by posture), and damping of a step."""
PREDICTED_POINTS, DEPARTURE_COST = 40, 0.00333
"""Equivalent points of a predicted pose, and cost of a deviation by one sigma, body lengths."""
MIN_POINTS, MIN_ERODED_PX, MIN_DEPTH_M = 25, 60, 0.1
"""Least depth points of an observation, least pixels of the eroded mask, least valid depth (meters)."""
RADIUS, FULL_VIEW, DEPTH_SHARE = 0.912, 0.44, 0.122
"""In body lengths: largest distance of points from their median, silhouette area in full view (squared), and
distance from the visible side to the center."""
BACK_QUANTILE = 0.8
"""Quantile of the template's heights that is its back's; head and tail may be higher."""
STANDING_STEP = 8
"""Stride of the points below which the surface height is measured."""
BEHIND = 0.0833
"""Depth farther than the template by this is behind it, body lengths."""


@dataclass(frozen=True)
class AgentModel:
    """The subsampled template: points, normals and colors in the agent frame, with a k-d tree."""

    points_agent: Float[np.ndarray, "point 3"]
    normals_agent: Float[np.ndarray, "point 3"]
    color: Float[np.ndarray, "point 3"]
    """0..1"""
    tree: KDTree
    length_m: float
    """`body_length_m` of the template."""
    stand_m: float
    """Height of the root above the paws."""
    body: ColoredBody | None = None
    """What pictures without measured depth are compared with."""


@dataclass(frozen=True)
class AgentObservation:
    """One frame's observation of the animal; meters, colors 0..1."""

    frame: int
    points_world: Float[np.ndarray, "point 3"]
    color: Float[np.ndarray, "point 3"]
    mask: Bool[np.ndarray, "height width"]
    depth: Float[np.ndarray, "depth_height depth_width"]
    world_from_camera: Float[np.ndarray, "4 4"]
    intrinsics: Float[np.ndarray, "3 3"]
    standing_m: float
    """Root height if the animal stands on the surface below, world y; NaN where there is none."""
    share: float
    """Visible share: mask area over the silhouette's area in full view at this distance."""
    picture: BodyPicture | None = None
    """The picture, if depth is not measured."""


def make_model(mesh: Mesh, rng: np.random.Generator) -> AgentModel:
    """Sample the template's vertices in proportion to area."""
    weight = np.bincount(mesh.faces.ravel(), np.repeat(mesh.face_areas(), 3), len(mesh.vertices))
    count = min(MODEL_POINTS, (weight > 0).sum())
    chosen = np.sort(rng.choice(len(mesh.vertices), count, replace=False, p=weight / weight.sum()))
    points = mesh.vertices[chosen].astype(float)
    color = np.full((len(chosen), 3), 0.5) if mesh.color is None else mesh.color[chosen] / 255.0
    stand_m, normals = float(-np.quantile(points[:, 1], 0.01)), mesh.vertex_normals()[chosen]
    return AgentModel(points, normals, color, KDTree(points, LEAF_POINTS), body_length_m(mesh), stand_m)


def observe(
    clip: Clip,
    mask: UInt8[np.ndarray, "height width"],
    frame: int,
    world_from_camera: Float[np.ndarray, "4 4"],
    model: AgentModel,
    standing: StandingSurface,
) -> AgentObservation | None:
    """Back-project the masked depth to the world, without the mask's border and outliers; None if too few."""
    inside = mask == 255
    depth = clip.depth(frame)
    small = cv2.resize(inside.astype(np.uint8), depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
    if clip.mapped:
        depth = _contact_depth(
            depth, small > 0, clip.depth_intrinsics[frame], world_from_camera, model, standing
        )
    eroded = cv2.erode(small, np.ones((3, 3), np.uint8))
    chosen = np.flatnonzero(
        ((eroded if eroded.sum() > MIN_ERODED_PX else small) > 0)
        & (depth > MIN_DEPTH_M)
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
    view = mask, depth, clip.intrinsics[frame], world_from_camera
    inner = points_world[::STANDING_STEP] + _offset_to_center(points_world, world_from_camera[:3, 3], model)
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
        picture=picture_fit.body_picture(clip.color(frame), *view) if clip.mapped else None,
    )


def _contact_depth(
    inferred: Float[np.ndarray, "height width"],
    inside: Bool[np.ndarray, "height width"],
    intrinsics: Float[np.ndarray, "3 3"],
    world_from_camera: Float[np.ndarray, "4 4"],
    model: AgentModel,
    standing: StandingSurface,
) -> Float[np.ndarray, "height width"]:
    """Replace inferred depth in the mask by that of an animal standing at its contact point with the map.

    Without a reliable contact point, and outside the mask, the inferred depth is kept.
    """
    ground_contact = contact.find(inside, intrinsics, world_from_camera, standing)
    if ground_contact is None or not ground_contact.certain:
        return inferred
    back_m = model.stand_m + float(np.quantile(model.points_agent[:, 1], BACK_QUANTILE))
    own = contact.depth_of(inside, ground_contact.point_world, back_m, intrinsics, world_from_camera)
    return np.where(inside, own, inferred)


def initial_poses(
    observation: AgentObservation, model: AgentModel, headings: int
) -> Float[np.ndarray, "pose 4 4"]:
    """Return upright poses at evenly spaced headings, centered slightly behind the visible points."""
    yaw = 2 * np.pi * np.arange(headings) / headings
    rotation = rigid.rotation_from_yaw(yaw)
    middle = np.median(observation.points_world, axis=0)
    middle = middle + _offset_to_center(observation.points_world, observation.world_from_camera[:3, 3], model)
    return rigid.make(rotation, middle - rotation @ np.median(model.points_agent, axis=0))


def _offset_to_center(points_world, eye, model):
    """Return the horizontal offset from the visible side of the body to its center."""
    away = (np.median(points_world, axis=0) - eye) * (1, 0, 1)
    return DEPTH_SHARE * model.length_m * away / max(np.linalg.norm(away), 1e-6)


def fit_coarse(
    observation: AgentObservation, model: AgentModel, world_from_agent: Float[np.ndarray, "pose 4 4"]
) -> Float[np.ndarray, "pose 4 4"]:
    """Fit upright from every pose with a narrowing robust kernel."""
    reach = np.geomspace(FIRST_REACH, REACH, COARSE_ROUNDS)
    return _fit(observation, model, world_from_agent, reach, UPRIGHT_SIGMA_RAD)


def fit_fine(
    observation: AgentObservation,
    model: AgentModel,
    world_from_agent: Float[np.ndarray, "pose 4 4"],
    *,
    rounds: int,
    tilt: bool,
) -> Float[np.ndarray, "pose 4 4"]:
    """Fit to convergence with and without the standing prior, and return the pose of lower cost.

    With ``tilt`` the root may tilt. Without measured depth, the picture decides.
    """
    if observation.picture is not None:
        return np.stack([_searched(observation, model, pose) for pose in world_from_agent])
    reach, prior = np.full(rounds, REACH), TILT_SIGMA_RAD if tilt else UPRIGHT_SIGMA_RAD
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
    """Standard deviations of rotation and position, radians and meters."""

    def twist(self, world_from_agent: Float[np.ndarray, "pose 4 4"]) -> Float[np.ndarray, "pose 6"]:
        """Return the twists from the predicted pose, in standard deviations."""
        offset = rigid.log(rigid.inverse(self.world_from_agent) @ world_from_agent)
        return offset / np.repeat(self.sigma, 3)

    def cost(self, world_from_agent: Float[np.ndarray, "pose 4 4"]) -> Float[np.ndarray, "pose"]:
        """Return the cost of the deviation, body lengths."""
        return DEPARTURE_COST * (self.twist(world_from_agent) ** 2).sum(-1)


@dataclass(frozen=True)
class PriorFit:
    """A pose fitted under a prior."""

    world_from_agent: Float[np.ndarray, "4 4"]
    cost: float
    """`cost` of the pose, body lengths."""
    total: float
    """The same plus the cost of deviation from the prediction, body lengths."""


def fit_near(observation: AgentObservation, model: AgentModel, prior: PosePrior, *, rounds: int) -> PriorFit:
    """Fit from a predicted pose with and without the standing prior, and return the lower total cost."""
    reach, start = np.full(rounds, REACH), prior.world_from_agent[None]
    if observation.picture is not None:
        pose = _searched(observation, model, prior.world_from_agent, prior)
        own = float(cost(observation, model, pose[None])[0])
        return PriorFit(pose, own, own + float(prior.cost(pose[None])[0]))
    fits = (
        _fit(observation, model, start, reach, TILT_SIGMA_RAD, stands=stands, near=prior)
        for stands in (True, False)
    )
    poses = np.concatenate(list(fits))
    own = cost(observation, model, poses)
    total = own + prior.cost(poses)
    best = int(total.argmin())
    return PriorFit(poses[best], float(own[best]), float(total[best]))


def _searched(observation, model, start, near=None):
    """Minimize the cost, with the priors of tilt and of a predicted pose, by pattern search."""

    def objective(pose: Float[np.ndarray, "4 4"]) -> float:
        tilt_rad = np.arccos(np.clip(pose[1, 1], -1, 1))
        total = cost(observation, model, pose[None])[0] + TILT_COST * (tilt_rad / TILT_SIGMA_RAD) ** 2
        return float(total if near is None else total + near.cost(pose[None])[0])

    return picture_fit.search(start, objective, observation.world_from_camera[:3, 3], model.length_m)


def _fit(observation, model, world_from_agent, reaches, prior, *, stands=True, near=None):
    """Run robust point-to-plane ICP with a weak point-to-point term; ``reaches`` in body lengths."""
    poses, length_m = np.array(world_from_agent, float), model.length_m
    for reach in length_m * reaches:
        local = rigid.apply(rigid.inverse(poses), observation.points_world[None])
        distance, nearest = model.tree.query(local)
        target, normal = model.points_agent[nearest], model.normals_agent[nearest]
        weight = (reach**2 / (reach**2 + distance**2)) ** 2
        gradient, hessian = _normal_equations(local, target, normal, weight)
        hessian, gradient = _add_upright_prior(poses, hessian, gradient, prior, length_m)
        if near is not None:
            hessian, gradient = _add_pose_prior(poses, hessian, gradient, near, length_m)
        if stands and np.isfinite(observation.standing_m):
            standing = observation.standing_m, length_m
            hessian, gradient = _add_standing_prior(poses, hessian, gradient, *standing)
        poses = poses @ rigid.exp(np.linalg.solve(hessian, -gradient[..., None])[..., 0])
    return poses


def _normal_equations(local, target, normal, weight):
    """Sum point-to-plane and point-to-point terms for the body's right-hand twist.

    Point terms are plane terms along the three axes, whose sums have closed forms.
    """
    gap, share, eye = local - target, POINT_WEIGHT * weight[..., None], np.eye(3)
    jacobian = np.concatenate([np.cross(local, normal), normal], axis=-1)
    scaled, weighted = (np.swapaxes(each, 1, 2) for each in (jacobian * weight[..., None], local * share))
    hessian, gradient = scaled @ jacobian, -(scaled @ (gap * normal).sum(-1, keepdims=True))[..., 0]
    outer, moment, lever = weighted @ local, weighted @ gap, np.cross(weighted.sum(-1)[:, None], eye)
    diagonal = np.trace(outer, axis1=1, axis2=2)[:, None, None] * eye - outer, share.sum(1)[:, None] * eye
    hessian += np.block([[diagonal[0], np.swapaxes(lever, 1, 2)], [lever, diagonal[1]]])
    torque = [moment[:, k - 2, k - 1] - moment[:, k - 1, k - 2] for k in range(3)]
    return gradient - np.stack([*torque, *(share * gap).sum(1).T], axis=-1), hessian


def _add_upright_prior(poses, hessian, gradient, prior_rad, length_m):
    """Add the prior that the tilt about the body's x and z axes is small."""
    up_agent = np.einsum("sji,j->si", poses[:, :3, :3], UP)
    precision = PRIOR_POINTS * (POINT_SIGMA * length_m / prior_rad) ** 2
    tilt = np.cross(UP, up_agent)
    for axis in (0, 2):
        hessian[:, axis, axis] += precision
        gradient[:, axis] -= precision * tilt[:, axis]
    hessian[:, range(6), range(6)] += DAMPING
    return hessian, gradient


def _add_pose_prior(poses, hessian, gradient, near, length_m):
    """Add the prior around a predicted pose, to first order in the twist."""
    precision = PREDICTED_POINTS * (POINT_SIGMA * length_m) ** 2 / np.repeat(near.sigma, 3)
    hessian[:, range(6), range(6)] += precision / np.repeat(near.sigma, 3)
    return hessian, gradient + precision * near.twist(poses)


def _add_standing_prior(poses, hessian, gradient, standing_m, length_m):
    """Add the robust prior that the animal stands on the surface below."""
    height, reach_m = poses[:, 1, 3] - standing_m, STAND_REACH * length_m
    weight = STAND_POINTS * (reach_m**2 / (reach_m**2 + height**2)) ** 2
    direction = poses[:, 1, :3]
    hessian[:, 3:, 3:] += weight[:, None, None] * direction[:, :, None] * direction[:, None, :]
    gradient[:, 3:] += (weight * height)[:, None] * direction
    return hessian, gradient


def cost(
    observation: AgentObservation, model: AgentModel, world_from_agent: Float[np.ndarray, "pose 4 4"]
) -> Float[np.ndarray, "pose"]:
    """Return each pose's cost, body lengths: truncated distance, standing, color, template outside mask.

    Without measured depth, outline and colors of the rendered template replace the last two.
    """
    local = rigid.apply(rigid.inverse(world_from_agent), observation.points_world[None])
    distance, nearest = model.tree.query(local)
    seen, expected = observation.color - observation.color.mean(0), model.color[nearest]
    color_error = np.abs(seen - (expected - expected.mean(1, keepdims=True))).mean((1, 2))
    height = np.nan_to_num(world_from_agent[:, 1, 3] - observation.standing_m) / model.length_m
    standing_error = height**2 / (height**2 + STAND_REACH**2)
    gap = np.minimum(distance / model.length_m, TRUNCATION * REACH).mean(1)
    if observation.picture is not None:
        assert model.body is not None, "pictures without measured depth need a colored body"
        shown = np.array([model.body.misfit(observation.picture, pose) for pose in world_from_agent])
        return CONTACT_WEIGHT * gap + STAND_COST * standing_error + PICTURE_COST * shown
    outside = _outside_share(observation, model, world_from_agent)
    return gap + STAND_COST * standing_error + COLOR_WEIGHT * color_error + OUTSIDE_WEIGHT * outside


def _outside_share(observation, model, world_from_agent):
    """Return the share of camera-facing points that project outside the mask in front of measured depth."""
    camera_from_agent = rigid.inverse(observation.world_from_camera) @ world_from_agent
    points = rigid.apply(camera_from_agent, model.points_agent[None])
    normals = model.normals_agent @ np.swapaxes(camera_from_agent[:, :3, :3], 1, 2)
    facing = (normals * points).sum(-1) < 0
    pixel, z = cameras.project(points, observation.intrinsics)
    height, width = observation.mask.shape
    inside = cameras.in_picture(pixel, z, (height, width), MIN_DEPTH_M)
    column = np.clip(pixel[..., 0], 0, width - 1).astype(int)
    row = np.clip(pixel[..., 1], 0, height - 1).astype(int)
    scale = np.array(observation.depth.shape) / (height, width)
    behind_m = observation.depth[(row * scale[0]).astype(int), (column * scale[1]).astype(int)] - z
    wrong = facing & inside & ~observation.mask[row, column] & (behind_m > BEHIND * model.length_m)
    return wrong.sum(1) / np.maximum(facing.sum(1), 1)
