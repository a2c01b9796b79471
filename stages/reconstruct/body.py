"""The agent's losses: masked depth against its field, its posed surface against the mask, priors on motion.

`posing` uses them to pose the template before the field is trained, and the joint phase while everything is
optimized.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor
from torch.nn import functional

from pipeline.geometry import cameras, rigid_torch
from stages.reconstruct import losses
from stages.reconstruct.config import LossWeights
from stages.reconstruct.problem import Problem, pick
from stages.reconstruct.rays import AGENT, THUMBNAIL, Rays
from stages.reconstruct.scene import Terms

UNIT = 0.167
"""unit of most losses of the posed surface, body lengths (`TemplateSurface.length_m`)"""
REACH = 0.0833
"""signed distances on the agent are truncated here, body lengths"""
OUTLIER = 0.167
"""measured points this far off have half the weight, body lengths; none is dropped, or the scene hides it"""
ROOT, ROOT_RAD = 0.0833, 0.05
"""standard deviation of registered roots, body lengths and radians"""
EDGE_M = 0.01
"""tolerance at the masks' edges"""
STILL = 0.01
"""smoothing of the L1 norm of bone and root steps, radians and `UNIT`"""
TOUCH_M, STRIDE = 0.02, 0.1
"""distance at which soles touch; motion between frames beyond which they are not held, body lengths"""
COVER = 0.025
"""a masked pixel is covered when a sample of the posed surface is seen this near to it, body lengths"""
MARGIN_M = 0.03
"""tolerance by which the posed surface may be in front of the measured depth"""
NEAREST_M = 0.1
"""points nearer to the camera than this are not in view"""
OUTSIDE_WEIGHT, UNCOVERED_WEIGHT, FREE_WEIGHT, PENETRATION_WEIGHT = 2.0, 2.0, 0.5, 2.0
"""weights per `UNIT`: posed surface outside the mask, uncovered masked pixels, surface in free space,
penetration of the scene. Tuned on the built-in cat; all are multiplied by `LossWeights.posed_surface`"""
RIGIDITY_WEIGHT, REST_WEIGHT, SMOOTH_WEIGHT, STILL_WEIGHT = 5.0, 0.05, 0.3, 0.1
"""weights of gaps at joints (per `UNIT`), twists from rest, accelerations, and the L1 norm of steps: an
animal mostly rests. All are multiplied by `LossWeights.motion_prior`"""
COMMON_REST = 20.0
"""additional weight of the mean twist of all bones: the root has to explain it"""
ROOT_SMOOTH, ROOT_STILL = 4.0, 0.5
"""the same weights for the root, relative to those of bones"""
ROOT_WEIGHT = 0.005
"""the agent's root stays near the registered one, per `ROOT` and `ROOT_RAD`, squared"""
FLOOR_EVERY = 4
"""one in so many surface points is tested for penetration, which costs most"""


@dataclass(frozen=True)
class Pose:
    """Poses of camera, agent and bones in some frames."""

    frame: Int[Tensor, "frame"]
    world_from_camera: Float[Tensor, "frame 4 4"]
    world_from_agent: Float[Tensor, "frame 4 4"]
    agent_from_bone: Float[Tensor, "frame bone 4 4"]
    world_from_initial: Float[Tensor, "frame 4 4"]
    """initial root, the mean of its prior: as registered, or with the lean of a sitting animal"""

    @property
    def agent_from_camera(self) -> Float[Tensor, "frame 4 4"]:
        """Pose of the camera in the agent's frame."""
        return rigid_torch.inverse(self.world_from_agent) @ self.world_from_camera

    @classmethod
    def of(cls, problem: Problem, frame: Int[Tensor, "frame"]) -> "Pose":
        """Read the motion table."""
        motion = problem.motion
        posed = motion.world_from_camera(frame), motion.world_from_agent(frame), motion.agent_from_bone(frame)
        return cls(frame, *posed, motion.initial_agent[frame])

    def at(self, chosen: Int[Tensor, "chosen"] | Bool[Tensor, "frame"] | slice) -> "Pose":
        """Choose frames by their numbers, a mask or a slice."""
        return Pose(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


def measured_terms(
    problem: Problem, pose: Pose, rays: Rays, weights: LossWeights, generator: Generator, near: int = 2
) -> Terms:
    """Return the losses at measured depth of rays ``[frame * ray]``, warped back to the rest shape."""
    frames, number, length_m = len(pose.frame), len(rays) // len(pose.frame), problem.surface.length_m
    offset = (torch.rand(len(rays), near, generator=generator).to(problem.device) * 2 - 1) * REACH * length_m
    depth = torch.cat([rays.depth[:, None], rays.depth[:, None] + offset], dim=1)
    points_camera = (rays.direction[:, None] * depth[..., None]).view(frames, -1, 3)
    points = rigid_torch.apply(pose.agent_from_camera, points_camera)
    rest = problem.body.unpose(points, pose.agent_from_bone)
    encoded = problem.agent.encode(rest.reshape(-1, 3))
    distance = problem.agent.distance(encoded).view(len(rays), 1 + near)
    target = (rays.depth[:, None] - depth) * rays.slope[:, None]
    color, feature = problem.agent.color_and_feature(encoded.view(len(rays), 1 + near, -1)[:, 0])
    good = (rays.label == AGENT) & (rays.depth > 0)
    trust = problem.trust[rays.frame] / (1 + distance[:, 0].detach().abs() / (OUTLIER * length_m))
    distance_loss = trust[:, None] * losses.truncated_distance(distance, target, REACH * length_m)
    terms = {
        "agent distance": (weights.agent_distance, distance_loss[good]),
        "agent color": (weights.color, (trust * losses.color(color, rays.color / 255))[good]),
    }
    if weights.feature:
        feature_loss = trust * losses.feature(feature, rays.feature / 127)
        terms["agent feature"] = weights.feature, feature_loss[good]
    if weights.cycle:
        at_depth, at_rest = (each.view(frames, number, 1 + near, 3)[:, :, 0] for each in (points, rest))
        back = problem.body.pose(at_rest, pose.agent_from_bone)
        squared = ((back - at_depth) / (UNIT * length_m)).square().sum(-1).view(-1)
        terms["cycle"] = weights.cycle, squared[good]
    return terms


def surface_terms(
    problem: Problem,
    pose: Pose,
    number: int,
    weights: LossWeights,
    generator: Generator,
    masked: Rays | None = None,
) -> Terms:
    """Penalize posed surface outside the mask unless occluded, in free space, and inside the scene.

    Rays ``masked`` ``[frame * ray]`` on the mask, with or without depth, must be covered by the surface.
    """
    views, surface = problem.store.views, problem.surface
    chosen, unit_m = pick(len(surface.points), number, generator, problem.device), UNIT * surface.length_m
    posed = problem.body.pose(surface.points[chosen], pose.agent_from_bone)
    points = rigid_torch.apply(rigid_torch.inverse(pose.agent_from_camera), posed)
    pixel, depth = cameras.project(points, views.intrinsics[pose.frame][:, None])
    size_px = views.size_px[pose.frame]
    # Outside the picture, read its border, not the padding.
    last = (size_px // THUMBNAIL - 0.5)[:, None] * THUMBNAIL
    within = torch.minimum(pixel.clamp_min(0.5 * THUMBNAIL), last)
    outside_px = _sampled(views.outside_px[pose.frame], within, "bilinear", "border")
    with torch.no_grad():
        measured = _sampled(views.depth[pose.frame], pixel, "nearest", "zeros")
        nearest = _sampled(views.occluder[pose.frame], pixel, "nearest", "zeros")
        inside_picture = ((pixel >= 0) & (pixel <= size_px[:, None])).all(-1)
        in_view = inside_picture & (depth > NEAREST_M)
        occluded = (nearest > 0) & (nearest < depth - MARGIN_M)
    focal_px = views.intrinsics[pose.frame, 0, 0][:, None]
    outside_m = functional.relu(outside_px * depth.detach() / focal_px - EDGE_M)
    in_front_m = functional.relu(measured - MARGIN_M - depth).clamp_max(2 * unit_m)
    trust = problem.trust[pose.frame, None]
    on_mask = outside_px.detach() < THUMBNAIL
    in_front = (trust * in_front_m / unit_m)[in_view & on_mask & (measured > 0)]
    terms = {
        "outside": (OUTSIDE_WEIGHT, (trust * outside_m / unit_m)[in_view & ~occluded]),
        "in front": (FREE_WEIGHT, in_front),
    }
    if problem.scene.fused:
        depth_m = penetration_depth_m(problem, pose, posed[:, ::FLOOR_EVERY])
        with_scene = problem.has_scene[pose.frame]
        terms["penetration"] = PENETRATION_WEIGHT, (trust * depth_m / unit_m)[with_scene]
    if masked is not None:
        residual_m = silhouette_residual_m(points, masked, COVER * surface.length_m).clamp_max(2 * unit_m)
        terms["uncovered"] = UNCOVERED_WEIGHT, trust * residual_m / unit_m
    return {name: (weights.posed_surface * weight, values) for name, (weight, values) in terms.items()}


def penetration_depth_m(
    problem: Problem, pose: Pose, points_agent: Float[Tensor, "frame point 3"]
) -> Float[Tensor, "frame point"]:
    """Return the penetration depth of points into the scene, meters."""
    return functional.relu(-height_m(problem, pose, rigid_torch.apply(pose.world_from_agent, points_agent)))


def height_m(
    problem: Problem, pose: Pose, world: Float[Tensor, "frame point 3"]
) -> Float[Tensor, "frame point"]:
    """Return the signed distance of world points to the scene of each frame's video, meters.

    Fused geometry is truncated and treats unseen space as free, so the floor plane is added.
    """
    video = problem.video[pose.frame][:, None].expand(world.shape[:2])
    video = torch.where(problem.has_scene[pose.frame, None], video, -1)
    outside = problem.scene.distance_at(world.reshape(-1, 3), video.reshape(-1)).view(world.shape[:2])
    return torch.minimum(outside, world[..., 1] - problem.floor_m)


def silhouette_residual_m(
    points_camera: Float[Tensor, "frame point 3"], masked: Rays, cover_m: float
) -> Float[Tensor, "frame ray"]:
    """Return the distance of each masked ray to the nearest projected point, meters beyond ``cover_m``."""
    target = masked.direction[:, :2].view(len(points_camera), -1, 2)
    depth = points_camera[..., 2:].clamp_min(NEAREST_M)
    image_point = points_camera[..., :2] / depth
    with torch.no_grad():
        squared = image_point.square().sum(-1)[:, None]  # without |target|^2, which is the same for all
        near = torch.baddbmm(squared, target, image_point.mT, alpha=-2).argmin(-1, keepdim=True)
    gap = image_point.gather(1, near.expand(-1, -1, 2)) - target
    return functional.relu(gap.norm(dim=-1) * depth.gather(1, near)[..., 0].detach() - cover_m)


def prior_terms(
    problem: Problem, pose: Pose, twist: Float[Tensor, "frame bone 6"], run: int, weights: LossWeights
) -> Terms:
    """Return the priors: joints closed, bones near rest, motion smooth and sparse in time, soles planted."""
    rest, joints, unit_m = problem.body.agent_from_bone_rest, problem.joints, UNIT * problem.surface.length_m
    motion = pose.agent_from_bone @ rigid_torch.inverse(rest)

    def moved(bone: Int[Tensor, "joint"]) -> Float[Tensor, "frame joint 3"]:
        return (motion[:, bone, :3, :3] @ joints.place[..., None])[..., 0] + motion[:, bone, :3, 3]

    joint_gap = (moved(joints.first) - moved(joints.second)) / unit_m
    root = rigid_torch.inverse(pose.world_from_initial) @ pose.world_from_agent
    offset = root[:, :3, 3] / (ROOT * problem.surface.length_m)
    root_error = offset.square().sum(-1) + _squared_angle(root) / ROOT_RAD**2
    common = twist.mean(1, keepdim=True).square().sum(-1)
    terms = {
        "rigidity": (RIGIDITY_WEIGHT, joint_gap.square().sum(-1)),
        "rest": (REST_WEIGHT, twist.square().sum(-1) + COMMON_REST * common),
    }
    if run >= 3:
        change, roots = twist.view(-1, run, *twist.shape[1:]), pose.world_from_agent.reshape(-1, run, 4, 4)
        acceleration = torch.diff(roots[:, :, :3].flatten(2), n=2, dim=1)
        step = rigid_torch.inverse(roots[:, :-1]) @ roots[:, 1:]
        root_step = (step[..., :3, 3] / unit_m).square().sum(-1) + _squared_angle(step)
        bone_step = torch.diff(change, dim=1).square().sum(-1)
        terms["smoothness"] = SMOOTH_WEIGHT, torch.diff(change, n=2, dim=1).square().sum(-1)
        terms["root smoothness"] = ROOT_SMOOTH * SMOOTH_WEIGHT, acceleration.square().sum(-1)
        terms["still"] = STILL_WEIGHT, _smooth_length(bone_step)
        terms["root still"] = ROOT_STILL * STILL_WEIGHT, _smooth_length(root_step)
    terms = {name: (weights.motion_prior * weight, values) for name, (weight, values) in terms.items()}
    terms["root"] = ROOT_WEIGHT, (problem.trust * problem.root_precision)[pose.frame] * root_error
    if run >= 3 and problem.scene.fused and weights.planted:
        terms["planted"] = weights.planted, foot_skate(problem, pose, run)
    return terms


def foot_skate(problem: Problem, pose: Pose, run: int) -> Float[Tensor, "run step sole"]:
    """Return the skate of soles in contact between frames: 0 at rest, saturating at 1 beyond `STRIDE`.

    Without it, occluded legs would follow the body. Soles in the air give 0.
    """
    posed = problem.body.pose(problem.surface.sole, pose.agent_from_bone)
    world = rigid_torch.apply(pose.world_from_agent, posed)
    with torch.no_grad():
        near = torch.exp(-(height_m(problem, pose, world).clamp_min(0) / TOUCH_M).square())
        near = near * problem.has_scene[pose.frame, None]
    contact = near.view(-1, run, near.shape[1])
    strides = world.view(-1, run, *world.shape[1:]) / (STRIDE * problem.surface.length_m)
    squared = torch.diff(strides, dim=1).square().sum(-1)
    return torch.minimum(contact[:, 1:], contact[:, :-1]) * squared / (squared + 1)


def _squared_angle(motion: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch"]:
    """Return the squared angle of small rotations."""
    return 3 - motion[..., :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1)


def _smooth_length(squared: Float[Tensor, "*step"]) -> Float[Tensor, "*step"]:
    """Return the Charbonnier norm of squared lengths: a prior for motion that is sparse in time."""
    return (squared.clamp_min(0) + STILL**2).sqrt() - STILL


def _sampled(
    images: Float[Tensor, "frame height width"],
    pixel: Float[Tensor, "frame point 2"],
    mode: Literal["bilinear", "nearest"],
    padding: Literal["border", "zeros"],
) -> Float[Tensor, "frame point"]:
    """Sample thumbnails at color pixels; bilinear sampling is differentiable in the pixel."""
    size = torch.tensor(images.shape[:0:-1], device=pixel.device, dtype=torch.float32) * THUMBNAIL
    place = (pixel / size * 2 - 1).clamp(-4, 4)[:, :, None]
    read = functional.grid_sample(
        images[:, None].float(), place, mode=mode, padding_mode=padding, align_corners=False
    )
    return read[:, 0, :, 0]
