"""The second phase: scene and agent together, all losses, composite rendering on rays around the agent."""

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from pipeline.fields.render import Layer, Rendered, composite, importance_depths
from pipeline.geometry import cameras, rigid_torch
from stages.reconstruct import body, losses
from stages.reconstruct.body import Pose
from stages.reconstruct.config import LossWeights, RayBatches
from stages.reconstruct.problem import Problem, pick
from stages.reconstruct.rays import AGENT, UNKNOWN, Rays
from stages.reconstruct.scene import (
    SceneLoss,
    Terms,
    camera_prior,
    render_depths,
    scene_density,
    scene_layer,
    surface_depths,
    swap_codes,
    swap_probability,
    uniform_depths,
)

RUN_FRAMES = 4
"""frames of each run, at least 3 for accelerations"""
AGENT_RAYS, SURFACE_POINTS = 32, 96
"""measured rays and surface points of the agent per frame and step"""
FIELD_POINTS, TEMPLATE_POINTS = 512, 4096
"""points around the template a step, in the second phase and while the field copies the template"""
EIKONAL_STEP_M = 0.01
"""step of finite differences, below the finest cell of the agent's grids"""
TEMPLATE_COLOR, TEMPLATE_FEATURE = 20.0, 0.3
"""weights of color and features against signed distance while the field copies the template"""
MIN_FLOW_CONFIDENCE, MIN_OPACITY = 25, 0.5
"""flow is compared where its confidence (of 255) and the rendered opacity are above these"""


class JointLoss:
    """All losses on random runs of frames."""

    def __init__(
        self,
        problem: Problem,
        weights: LossWeights,
        batches: RayBatches,
        steps: int,
        rendered: bool = False,
        begun: int = 0,
    ):
        """``steps``: of both phases, of which ``begun`` are done; ``rendered``: uniform and importance
        samples, not samples around measured depth (ATS, A.1).
        """
        self.problem, self.weights, self.batches, self.steps = problem, weights, batches, steps
        self.begun = begun
        self.scene_loss = SceneLoss(problem, weights, batches, steps, rendered)
        self.run_frames = RUN_FRAMES if len(problem.runs(RUN_FRAMES)) else 1
        self.first = problem.runs(self.run_frames).to(problem.device)

    def __call__(self, step: int, generator: Generator) -> dict[str, Tensor]:
        problem, batches, weights = self.problem, self.batches, self.weights
        probability = swap_probability((self.begun + step) / self.steps, batches)
        start = self.first[pick(len(self.first), batches.runs, generator, problem.device)]
        frame = (start[:, None] + torch.arange(self.run_frames, device=problem.device)).flatten()
        pose = Pose.of(problem, frame)
        measured = problem.store.agent.at(problem.agent_rays.pick(frame, AGENT_RAYS, generator).flatten())
        terms = self.scene_loss.terms(batches.joint_scene_rays, probability, generator)
        terms |= body.measured_terms(problem, pose, measured, weights, generator)
        if weights.posed_surface:
            terms |= body.surface_terms(problem, pose, SURFACE_POINTS, weights, generator)
        terms |= body.prior_terms(problem, pose, problem.motion.bone[frame], self.run_frames, weights)
        terms |= self._rendered(pose, max(1, batches.rendered_rays // len(frame)), probability, generator)
        terms |= field_terms(problem, weights, generator) | camera_prior(problem)
        return losses.weighted(terms, shared=True)

    def _rendered(self, pose: Pose, number: int, probability: float, generator: Generator) -> Terms:
        """Return the losses of ``number`` rendered rays per frame on and around the agent."""
        problem, samples = self.problem, self.batches.rendered_samples
        rays = problem.store.agent.at(problem.agent_rays.pick(pose.frame, number, generator).flatten())
        has_scene = problem.has_scene[rays.frame]
        video = torch.where(has_scene, problem.video[rays.frame], 0)
        farthest_m = problem.store.farthest_m
        code_of = swap_codes(video, problem.scene.shape.videos, probability, generator)
        frame = torch.arange(len(pose.frame), device=problem.device).repeat_interleave(number)

        def density_of(index: Tensor, depth: Tensor, min_beta_m: float = 0.0) -> Tensor:
            there = pose.at(frame[index])
            world, points_agent = sample_points(there, rays.at(index), depth)
            scene = scene_density(problem, world, video[index], code_of[index], min_beta_m)
            agent = agent_layer(problem, there, points_agent, depth.shape, min_beta_m)[0].density
            return scene * has_scene[index, None] + agent

        if self.scene_loss.rendered:
            coarse, half_m = uniform_depths(rays, farthest_m, samples // 2, generator), farthest_m / samples
            with torch.no_grad():
                both = density_of(torch.arange(len(rays), device=problem.device), coarse, half_m)
                fine = importance_depths(coarse, rays.direction.norm(dim=-1), both, generator)
            depth = torch.cat([coarse, fine], dim=1).sort(dim=1).values
        else:
            surface = surface_depths(rays, farthest_m, density_of, generator)
            depth = render_depths(rays, surface, samples, generator)
        world, points_agent = sample_points(pose, rays, depth)
        scene = scene_layer(problem, world, video, code_of)
        scene = Layer(scene.density * has_scene[:, None], scene.color, scene.feature)
        agent, rest = agent_layer(problem, pose, points_agent, depth.shape)
        rendered = composite(depth, rays.direction.norm(dim=-1), scene, agent)
        return rendering_terms(problem, pose, rays, rendered, world, rest, has_scene, self.weights)


def sample_points(
    pose: Pose, rays: Rays, depth: Float[Tensor, "ray sample"]
) -> tuple[Float[Tensor, "ray sample 3"], Float[Tensor, "frame point 3"]]:
    """Return samples of rays ``[frame * ray]`` in the world, and per frame in the agent's frame, meters."""
    points_camera = (rays.direction[:, None] * depth[..., None]).view(len(pose.frame), -1, 3)
    world = rigid_torch.apply(pose.world_from_camera, points_camera).view(*depth.shape, 3)
    return world, rigid_torch.apply(pose.agent_from_camera, points_camera)


def agent_layer(
    problem: Problem,
    pose: Pose,
    points_agent: Float[Tensor, "frame point 3"],
    shape: tuple[int, ...],
    min_beta_m: float = 0.0,
) -> tuple[Layer, Float[Tensor, "frame point 3"]]:
    """Evaluate the agent's field along rays (`Field.density` explains ``min_beta_m``); also return the
    samples in the rest shape. It is empty outside its box."""
    rest = problem.body.unpose(points_agent, pose.agent_from_bone)
    return Layer.of_agent(problem.agent, rest, shape, min_beta_m), rest


def rendering_terms(
    problem: Problem,
    pose: Pose,
    rays: Rays,
    rendered: Rendered,
    world: Float[Tensor, "ray sample 3"],
    rest: Float[Tensor, "frame point 3"],
    has_scene: Bool[Tensor, "ray"],
    weights: LossWeights,
) -> Terms:
    """Return the rendering losses, each over the rays that have its observation."""
    on_agent, known = rays.label == AGENT, rays.label != UNKNOWN
    whole = known & (has_scene | on_agent)
    flow_px, flow_good = predict_flow_pixels(problem, pose, rays, rendered, world, rest)
    flow_good = flow_good & whole
    trust = (rays.flow_confidence / 255)[flow_good]
    return {
        "rendered agent color": (
            weights.rendered_color,
            losses.color(rendered.color, rays.color / 255)[whole],
        ),
        "rendered agent feature": (
            weights.rendered_feature,
            losses.feature(rendered.feature, rays.feature / 127)[whole],
        ),
        "rendered agent depth": (
            weights.rendered_depth,
            losses.depth(rendered.depth, rays.depth)[whole & (rays.depth > 0)],
        ),
        "silhouette": (weights.silhouette, losses.silhouette(rendered.agent, on_agent.float())[known]),
        "flow": (weights.flow, trust * losses.flow(flow_px[flow_good], rays.flow_px[flow_good])),
    }


def predict_flow_pixels(
    problem: Problem,
    pose: Pose,
    rays: Rays,
    rendered: Rendered,
    world: Float[Tensor, "ray sample 3"],
    rest: Float[Tensor, "frame point 3"],
) -> tuple[Float[Tensor, "ray 2"], Bool[Tensor, "ray"]]:
    """Return the pixels of rendered points in the flow's later frame, and for which rays they are valid.

    The later position of a sample blends those of the static scene and of the moving agent by density.
    """
    frames, number = len(pose.frame), len(rays) // len(pose.frame)
    later = (rays.frame + rays.flow_gap).view(frames, number)[:, 0].clamp_max(len(problem.video) - 1)
    usable = (problem.video[later] == problem.video[pose.frame]) & torch.isin(later, problem.agent_frames)
    then = Pose.of(problem, later)
    scene_camera = rigid_torch.apply(rigid_torch.inverse(then.world_from_camera), world.view(frames, -1, 3))
    posed = problem.body.pose(rest, then.agent_from_bone)
    agent_camera = rigid_torch.apply(rigid_torch.inverse(then.agent_from_camera), posed)
    share = rendered.agent_share.view(frames, -1, 1)
    mixed = (scene_camera + share * (agent_camera - scene_camera)).view(*rendered.weight.shape, 3)
    point = (rendered.weight[..., None] * mixed).sum(1) / rendered.opacity.clamp_min(1e-3)[:, None]
    pixel, ahead = cameras.project(point, problem.store.views.intrinsics[later].repeat_interleave(number, 0))
    return pixel, usable.repeat_interleave(number) & (ahead > body.NEAREST_M) & (
        rays.flow_confidence > MIN_FLOW_CONFIDENCE
    ) & (rendered.opacity.detach() > MIN_OPACITY)


def field_terms(problem: Problem, weights: LossWeights, generator: Generator) -> Terms:
    """Return the agent's eikonal loss and the losses that keep its field near the template."""
    field, surface = problem.agent, problem.surface
    index = pick(len(surface.around), FIELD_POINTS, generator, problem.device)
    points = surface.around[index]
    neighbors = points + EIKONAL_STEP_M * torch.eye(3, device=problem.device)[:, None]
    encoded = field.encode(torch.cat([points[None], neighbors]).view(-1, 3))
    distance, *shifted = field.distance(encoded).view(4, -1)
    reach_m = body.REACH * surface.length_m
    close = surface.distance[index].abs() < reach_m
    color = field.color_and_feature(encoded[: len(index)][close])[0]
    return {
        "agent eikonal": (weights.eikonal, losses.eikonal(distance, torch.stack(shifted), EIKONAL_STEP_M)),
        "template": (weights.template, losses.distance(distance, surface.distance[index], reach_m)),
        "template color": (
            weights.template * weights.color,
            losses.color(color, surface.color[index][close]),
        ),
    }


class TemplateLoss:
    """The loss of the agent's field against its template."""

    def __init__(self, problem: Problem):
        self.problem = problem

    def __call__(self, step: int, generator: Generator) -> dict[str, Tensor]:
        surface, field = self.problem.surface, self.problem.agent
        index = pick(len(surface.around), TEMPLATE_POINTS, generator, self.problem.device)
        values, reach_m = field(surface.around[index]), body.REACH * surface.length_m
        close = surface.distance[index].abs() < reach_m
        return losses.weighted(
            {
                "distance": (1.0, ((values.signed_distance - surface.distance[index]) / reach_m).abs()),
                "color": (TEMPLATE_COLOR, losses.color(values.color, surface.color[index])[close]),
                "feature": (TEMPLATE_FEATURE, losses.feature(values.feature, surface.feature[index])[close]),
            },
            shared=True,
        )
