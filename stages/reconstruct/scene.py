"""The scene's losses: signed distance around measured depth, colour and features at it, and rendered rays."""

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor

from pipeline.models.fields import density
from pipeline.models.motion import MotionTable
from pipeline.models.render import Layer, composite
from stages.reconstruct import losses
from stages.reconstruct.problem import Problem, pick
from stages.reconstruct.rays import Rays
from stages.reconstruct.settings import Batches, Weights

Terms = dict[str, tuple[float, Tensor]]
FREE_FROM_M = 0.1
BEHIND_M = 0.06
"""samples behind a measured surface; deeper ones would fill thin things and what lies behind edges"""
EIKONAL_STEP_M = 0.04


def swap_probability(progress: float, batches: Batches) -> float:
    """Return how often codes are swapped, linearly from first to last (paper 001, scene annealing)."""
    return batches.swap_first + (batches.swap_last - batches.swap_first) * progress


def swap(video: Int[Tensor, "ray"], videos: int, probability: float, generator: Generator) -> Int[Tensor, "ray"]:
    """Replace the code's index by another video's with some probability (paper 001, scene annealing); without codes nothing changes."""
    if not videos:
        return video
    other = torch.randint(videos, video.shape, generator=generator).to(video.device)
    return torch.where((torch.rand(video.shape, generator=generator) < probability).to(video.device), other, video)


def world_rays(motion: MotionTable, rays: Rays) -> tuple[Float[Tensor, "ray 3"], Float[Tensor, "ray 3"]]:
    """Return origins and directions (one metre of depth long) in the world."""
    pose = motion.world_from_camera(rays.frame)
    return pose[:, :3, 3], (pose[:, :3, :3] @ rays.direction[..., None])[..., 0]


def sample_depths(rays: Rays, near: int, free: int, reach_m: float, generator: Generator) -> Float[Tensor, "ray sample"]:
    """Return the measured depth, samples from ``reach_m`` before the surface to just behind it, and samples in the free space before it."""
    device, depth = rays.depth.device, rays.depth[:, None]
    place = torch.rand(len(rays), near, generator=generator).to(device)
    around = place * (reach_m / rays.slope[:, None].clamp_min(0.3) + BEHIND_M) - BEHIND_M
    step = (torch.arange(free, device=device) + torch.rand(len(rays), free, generator=generator).to(device)) / max(free, 1)
    before = FREE_FROM_M + (depth - reach_m - FREE_FROM_M).clamp_min(0) * step
    return torch.cat([depth, depth - around, before], dim=1)


def measured_terms(
    problem: Problem, rays: Rays, code_of: Int[Tensor, "ray"], weights: Weights, batches: Batches, generator: Generator
) -> Terms:
    """Fit the scene where the sensor measured: rays of known depth."""
    field, limit = problem.scene, problem.scene.shape.truncation_m
    origin, direction = world_rays(problem.motion, rays)
    depth = sample_depths(rays, batches.near, batches.free, limit, generator)
    points = origin[:, None] + direction[:, None] * depth[..., None]
    video, samples = problem.video[rays.frame], depth.shape[1]
    distance = field.distance_at(points.view(-1, 3), video.repeat_interleave(samples), code_of.repeat_interleave(samples)).view(-1, samples)
    target = (rays.depth[:, None] - depth) * rays.slope[:, None]
    target[:, 1 + batches.near :] = target[:, 1 + batches.near :].clamp_min(limit)
    color, feature = field.look(field.encode(points[:, 0], video, code_of))
    terms = {
        "distance": (weights.distance, losses.truncated_distance(distance, target, limit)),
        "color": (weights.color, losses.color(color, rays.color / 255)),
        "feature": (weights.feature, losses.feature(feature, rays.feature / 127)),
    }
    if field.fused is None:
        few = slice(0, len(rays) // 8)
        beside = points[few, 0].detach() + EIKONAL_STEP_M * torch.eye(3, device=problem.device)[:, None]
        shifted = field.distance_at(beside.reshape(-1, 3), video[few].repeat(3), code_of[few].repeat(3)).view(3, -1)
        terms["eikonal"] = (weights.eikonal, losses.eikonal(distance[few, 0], shifted, EIKONAL_STEP_M))
    return terms


def rendered_terms(
    problem: Problem, rays: Rays, code_of: Int[Tensor, "ray"], weights: Weights, depth: Float[Tensor, "ray sample"]
) -> Terms:
    """Fit the scene by volume rendering at samples ``depth``: any rays, with or without measured depth."""
    origin, direction = world_rays(problem.motion, rays)
    points = origin[:, None] + direction[:, None] * depth[..., None]
    scene = scene_layer(problem, points, problem.video[rays.frame], code_of)
    empty = Layer(torch.zeros_like(scene.density), torch.zeros_like(scene.color), torch.zeros_like(scene.feature))
    seen = composite(depth, direction.norm(dim=-1), scene, empty)
    known = rays.depth > 0
    return {
        "rendered color": (weights.rendered_color, losses.color(seen.color, rays.color / 255)),
        "rendered feature": (weights.rendered_feature, losses.feature(seen.feature, rays.feature / 127)),
        "rendered depth": (weights.rendered_depth, losses.depth(seen.depth, rays.depth)[known]),
    }


def scene_layer(problem: Problem, points: Float[Tensor, "ray sample 3"], video: Int[Tensor, "ray"], code_of: Int[Tensor, "ray"]) -> Layer:
    """Ask the scene's field along rays, each with its video's scene and some video's code."""
    field, (rays, samples) = problem.scene, points.shape[:2]
    values = field(points.reshape(-1, 3), video.repeat_interleave(samples), code_of.repeat_interleave(samples))
    return Layer(
        density(values.signed_distance, field.beta_m).view(rays, samples),
        values.color.view(rays, samples, 3),
        values.feature.view(rays, samples, -1),
    )


def render_depths(
    rays: Rays, farthest_m: float, generator: Generator, around: int = 12, along: int = 12, reach_m: float = 0.15
) -> Float[Tensor, "ray sample"]:
    """Place samples for rendering: half around the measured depth, half up to it (up to ``farthest_m`` where it is unknown)."""
    device = rays.depth.device
    end = torch.where(rays.depth > 0, rays.depth, torch.full_like(rays.depth, farthest_m))[:, None]

    def strata(count: int) -> Tensor:
        return (torch.arange(count, device=device) + torch.rand(len(rays), count, generator=generator).to(device)) / count

    near = end + (strata(around) * 2 - 1) * reach_m
    far = FREE_FROM_M + (end - reach_m - FREE_FROM_M).clamp_min(0.01) * strata(along)
    return torch.cat([far, near], dim=1).sort(dim=1).values


def even_depths(rays: Rays, farthest_m: float, samples: int, generator: Generator) -> Float[Tensor, "ray sample"]:
    """Place samples evenly up to ``farthest_m``, wherever the surface is."""
    step = torch.arange(samples) + torch.rand(len(rays), samples, generator=generator)
    return (FREE_FROM_M + (farthest_m - FREE_FROM_M) * step / samples).to(rays.depth.device)


def drift_term(problem: Problem, weights: Weights) -> Terms:
    """Keep the corrections of cameras small where registration is sure, and those of neighbouring knots alike: 1 cm and half a degree."""
    motion, unit = problem.motion, 0.01
    return {
        "drift": (weights.drift, (torch.diff(motion.camera, dim=0) / unit).square()),
        "anchor": (weights.anchor, problem.firm[:, None] * (motion.camera / unit).square()),
    }


class SceneLoss:
    """The loss of the first phase: scene and cameras, feature-metric loss included."""

    def __init__(self, problem: Problem, weights: Weights, batches: Batches, steps: int):
        self.problem, self.weights, self.batches, self.steps = problem, weights, batches, steps
        self.measured = torch.nonzero(problem.store.scene.depth > 0)[:, 0].int()

    def __call__(self, step: int, generator: Generator) -> dict[str, Tensor]:
        return losses.weighted(
            self.terms(self.batches.scene_rays, swap_probability(step / self.steps, self.batches), generator)
            | drift_term(self.problem, self.weights),
            shared=True,
        )

    def terms(self, number: int, probability: float, generator: Generator) -> Terms:
        """Return the scene's terms over random rays."""
        problem, store, batches = self.problem, self.problem.store, self.batches
        if batches.places == "even":
            rays = store.scene.at(pick(len(store.scene), number // 6, generator, problem.device))
            code_of = swap(problem.video[rays.frame], problem.scene.shape.videos, probability, generator)
            return rendered_terms(problem, rays, code_of, self.weights, even_depths(rays, store.farthest_m, batches.even, generator))
        rays = store.scene.at(self.measured[pick(len(self.measured), number, generator, problem.device)])
        others = store.scene.at(pick(len(store.scene), batches.rendered_rays // 2, generator, problem.device))
        videos = problem.scene.shape.videos
        code_of, other_code = (swap(problem.video[some.frame], videos, probability, generator) for some in (rays, others))
        found = measured_terms(problem, rays, code_of, self.weights, batches, generator)
        return found | rendered_terms(problem, others, other_code, self.weights, render_depths(others, store.farthest_m, generator))
