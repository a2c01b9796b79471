"""The second phase: scene and agent together, all losses, composite rendering on rays around the agent."""

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from pipeline.models.fields import density
from pipeline.models.render import Layer, Rendered, composite
from pipeline.space import cameras, rigid_torch
from stages.reconstruct import body, losses
from stages.reconstruct.body import Pose
from stages.reconstruct.problem import Problem, pick
from stages.reconstruct.rays import AGENT, UNKNOWN, Rays
from stages.reconstruct.scene import SceneLoss, Terms, drift_term, render_depths, scene_layer, swap, swap_probability
from stages.reconstruct.settings import Batches, Weights

EIKONAL_STEP_M = 0.01


class JointLoss:
    """All losses of the paper on random runs of frames."""

    def __init__(self, problem: Problem, weights: Weights, batches: Batches, steps: int):
        self.problem, self.weights, self.batches, self.steps = problem, weights, batches, steps
        self.scene_loss = SceneLoss(problem, weights, batches, steps)
        self.run_frames = batches.run_frames if len(problem.runs(batches.run_frames)) else 1
        self.first = problem.runs(self.run_frames).to(problem.device)

    def __call__(self, step: int, generator: Generator) -> dict[str, Tensor]:
        problem, batches, probability = self.problem, self.batches, swap_probability(step / self.steps, self.batches)
        start = self.first[pick(len(self.first), batches.runs, generator, problem.device)]
        frame = (start[:, None] + torch.arange(self.run_frames, device=problem.device)).flatten()
        pose = Pose.of(problem, frame)
        measured = problem.store.agent.at(problem.agent_rays.pick(frame, batches.agent_rays, generator).flatten())
        terms = self.scene_loss.terms(batches.joint_scene_rays, probability, generator)
        terms |= body.measured_terms(problem, pose, measured, self.weights, generator)
        terms |= body.surface_terms(problem, pose, batches.surface_points, self.weights, generator)
        terms |= body.prior_terms(problem, pose, problem.motion.bone[frame], self.run_frames, self.weights)
        terms |= rendered_terms(problem, pose, max(1, batches.rendered_rays // len(frame)), probability, self.weights, generator)
        terms |= field_terms(problem, self.weights, generator) | drift_term(problem, self.weights)
        return losses.weighted(terms, shared=True)


def rendered_terms(problem: Problem, pose: Pose, number: int, probability: float, weights: Weights, generator: Generator) -> Terms:
    """Render ``number`` rays per frame on and around the agent through both fields and compare all that is known."""
    rays = problem.store.agent.at(problem.agent_rays.pick(pose.frame, number, generator).flatten())
    depth = render_depths(rays, problem.store.farthest_m, generator)
    frames, samples = len(pose.frame), depth.shape[1]
    points_camera = rays.direction[:, None] * depth[..., None]
    world = rigid_torch.apply(pose.world_from_camera, points_camera.view(frames, -1, 3)).view(len(rays), samples, 3)
    has_scene = problem.has_scene[rays.frame]
    video = torch.where(has_scene, problem.video[rays.frame], 0)
    scene = scene_layer(problem, world, video, swap(video, problem.scene.shape.videos, probability, generator))
    scene = Layer(scene.density * has_scene[:, None], scene.color, scene.feature)
    points_agent = rigid_torch.apply(pose.agent_from_camera, points_camera.view(frames, -1, 3))
    agent, rest = agent_layer(problem, pose, points_agent, (len(rays), samples))
    seen = composite(depth, rays.direction.norm(dim=-1), scene, agent)
    return compare(problem, pose, rays, seen, world, rest, has_scene, weights)


def agent_layer(
    problem: Problem, pose: Pose, points_agent: Float[Tensor, "frame point 3"], shape: tuple[int, int]
) -> tuple[Layer, Float[Tensor, "frame point 3"]]:
    """Ask the agent's field along rays; also return where the samples lie at rest. Outside its box there is nothing."""
    field = problem.agent
    rest = problem.body.unpose(points_agent, pose.agent_from_bone)
    low, high = (torch.tensor(corner, device=problem.device) for corner in (field.shape.low_m, field.shape.high_m))
    inside = ((rest > low) & (rest < high)).all(-1).view(shape)
    values = field(rest.reshape(-1, 3))
    layer = Layer(
        density(values.signed_distance, field.beta_m).view(shape) * inside, values.color.view(*shape, 3), values.feature.view(*shape, -1)
    )
    return layer, rest


def compare(
    problem: Problem, pose: Pose, rays: Rays, seen: Rendered, world: Tensor, rest: Tensor, has_scene: Tensor, weights: Weights
) -> Terms:
    """Return the rendering losses over the rays for which each makes sense."""
    on_agent, known = rays.label == AGENT, rays.label != UNKNOWN
    whole = known & (has_scene | on_agent)
    flow_px, flow_good = later_pixels(problem, pose, rays, seen, world, rest)
    flow_good = flow_good & whole
    trust = (rays.flow_confidence / 255)[flow_good]
    return {
        "rendered agent color": (weights.rendered_color, losses.color(seen.color, rays.color / 255)[whole]),
        "rendered agent feature": (weights.rendered_feature, losses.feature(seen.feature, rays.feature / 127)[whole]),
        "rendered agent depth": (weights.rendered_depth, losses.depth(seen.depth, rays.depth)[whole & (rays.depth > 0)]),
        "silhouette": (weights.silhouette, losses.silhouette(seen.agent, on_agent.float())[known]),
        "flow": (weights.flow, trust * losses.flow(flow_px[flow_good], rays.flow_px[flow_good])),
    }


def later_pixels(
    problem: Problem, pose: Pose, rays: Rays, seen: Rendered, world: Tensor, rest: Tensor
) -> tuple[Float[Tensor, "ray 2"], Tensor]:
    """Return where rendered points are seen at the flow's later frame, and for which rays that can be said.

    A sample's later place mixes the scene's (it stays) and the agent's (it follows the bones), by density.
    """
    frames, number = len(pose.frame), len(rays) // len(pose.frame)
    later = (rays.frame + rays.flow_gap).view(frames, number)[:, 0].clamp_max(len(problem.video) - 1)
    usable = (problem.video[later] == problem.video[pose.frame]) & torch.isin(later, problem.agent_frames)
    then = Pose.of(problem, later)
    scene_camera = rigid_torch.apply(rigid_torch.inverse(then.world_from_camera), world.view(frames, -1, 3))
    posed = problem.body.pose(rest, then.agent_from_bone)
    agent_camera = rigid_torch.apply(rigid_torch.inverse(then.agent_from_camera), posed)
    share = seen.agent_share.view(frames, -1, 1)
    mixed = (scene_camera + share * (agent_camera - scene_camera)).view(*seen.weight.shape, 3)
    point = (seen.weight[..., None] * mixed).sum(1) / seen.opacity.clamp_min(1e-3)[:, None]
    pixel, ahead = cameras.project(point, problem.store.views.intrinsics[later].repeat_interleave(number, 0))
    return pixel, usable.repeat_interleave(number) & (ahead > 0.1) & (rays.flow_confidence > 25) & (seen.opacity.detach() > 0.5)


def field_terms(problem: Problem, weights: Weights, generator: Generator, number: int = 512) -> Terms:
    """Keep the agent's field a distance field, and near its template in shape and colour."""
    field, surface = problem.agent, problem.surface
    index = pick(len(surface.around), number, generator, problem.device)
    points = surface.around[index]
    beside = points + EIKONAL_STEP_M * torch.eye(3, device=problem.device)[:, None]
    encoded = field.encode(torch.cat([points[None], beside]).view(-1, 3))
    distance, *shifted = field.distance(encoded).view(4, -1)
    close = surface.distance[index].abs() < body.REACH_M
    color = field.look(encoded[: len(index)][close])[0]
    return {
        "agent eikonal": (weights.eikonal, losses.eikonal(distance, torch.stack(shifted), EIKONAL_STEP_M)),
        "template": (weights.template, losses.truncated_distance(distance, surface.distance[index], body.REACH_M)),
        "template color": (weights.template * weights.color, losses.color(color, surface.color[index][close])),
    }


class TemplateLoss:
    """Copies the agent template into the agent's field."""

    def __init__(self, problem: Problem, number: int = 4096):
        self.problem, self.number = problem, number

    def __call__(self, step: int, generator: Generator) -> dict[str, Tensor]:
        surface, field = self.problem.surface, self.problem.agent
        index = pick(len(surface.around), self.number, generator, self.problem.device)
        values = field(surface.around[index])
        close = surface.distance[index].abs() < body.REACH_M
        return losses.weighted(
            {
                "distance": (1.0, ((values.signed_distance - surface.distance[index]) / body.REACH_M).abs()),
                "color": (20.0, losses.color(values.color, surface.color[index])[close]),
                "feature": (0.3, losses.feature(values.feature, surface.feature[index])[close]),
            },
            shared=True,
        )
