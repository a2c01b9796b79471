"""The scene's losses: signed distance around measured depth, color and features at it, and rendered rays."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor

from pipeline.data.motion import MotionTable
from pipeline.fields.fields import Field
from pipeline.fields.render import Layer, composite, importance_depths, ray_weights
from stages.reconstruct import losses
from stages.reconstruct.config import LossWeights, RayBatches
from stages.reconstruct.problem import Problem, pick
from stages.reconstruct.rays import Rays

Terms = dict[str, tuple[float, Tensor]]
"""weight and values per element of each loss"""
RAY_START_M = 0.1
"""z at which ray samples begin"""
NEAR, FREE = 4, 3
"""samples of a ray near its measured depth, and in the free space before it"""
BEHIND_M = 0.06
"""samples reach this far behind measured depth; deeper ones would thicken thin objects and fill occlusions"""
MIN_SLOPE = 0.3
"""lower bound of the slope by which the range of samples near depth grows on oblique surfaces"""
REACH_M = 0.15
"""half of the samples of rendered rays lie this near to measured depth"""
SEARCH_SAMPLES = 64
"""uniform samples that locate the surface where depth is unknown"""
EIKONAL_STEP_M = 0.04
"""step of finite differences, half a cell of the finest grid"""
EIKONAL_SHARE = 8
"""one ray in so many is used for the eikonal loss"""
DRIFT_WEIGHT, ANCHOR_WEIGHT, CAMERA_M = 0.1, 0.05, 0.01
"""weights of differences between neighboring camera knots and of their size; unit of both, 0.6 degrees"""


def swap_probability(progress: float, batches: RayBatches) -> float:
    """Return the probability of code swaps, linear from first to last (ATS, scene annealing)."""
    return batches.swap_first + (batches.swap_last - batches.swap_first) * progress


def swap_codes(
    video: Int[Tensor, "ray"], videos: int, probability: float, generator: Generator
) -> Int[Tensor, "ray"]:
    """Replace each code's index by a random one with some probability (ATS, scene annealing).

    Without codes nothing changes.
    """
    if not videos:
        return video
    other = torch.randint(videos, video.shape, generator=generator).to(video.device)
    swapped = torch.rand(video.shape, generator=generator) < probability
    return torch.where(swapped.to(video.device), other, video)


def world_samples(
    motion: MotionTable, rays: Rays, depth: Float[Tensor, "ray sample"]
) -> tuple[Float[Tensor, "ray sample 3"], Float[Tensor, "ray"]]:
    """Return the points of rays at ``depth`` in the world, and the lengths of rays per meter of depth."""
    pose = motion.world_from_camera(rays.frame)
    direction = (pose[:, :3, :3] @ rays.direction[..., None])[..., 0]
    return pose[:, None, :3, 3] + direction[:, None] * depth[..., None], direction.norm(dim=-1)


def sample_depths(rays: Rays, reach_m: float, generator: Generator) -> Float[Tensor, "ray sample"]:
    """Return depth samples in meters: the measured one, `NEAR` around it, `FREE` in the free space before."""
    depth = rays.depth[:, None]
    place = torch.rand(len(rays), NEAR, generator=generator).to(depth.device)
    around = place * (reach_m / rays.slope[:, None].clamp_min(MIN_SLOPE) + BEHIND_M) - BEHIND_M
    before = RAY_START_M + (depth - reach_m - RAY_START_M).clamp_min(0) * strata(rays, FREE, generator)
    return torch.cat([depth, depth - around, before], dim=1)


def strata(rays: Rays, count: int, generator: Generator) -> Float[Tensor, "ray sample"]:
    """Return ``count`` stratified random numbers in 0..1 for each ray, increasing."""
    device = rays.depth.device
    offset = torch.rand(len(rays), count, generator=generator).to(device)
    return (torch.arange(count, device=device) + offset) / count


def measured_terms(
    problem: Problem, rays: Rays, code_of: Int[Tensor, "ray"], weights: LossWeights, generator: Generator
) -> Terms:
    """Return the scene's losses at and before measured depth."""
    field, limit = problem.scene, problem.scene.shape.truncation_m
    assert limit is not None, "untruncated scenes are learned by rendering"
    depth = sample_depths(rays, limit, generator)
    points, _ = world_samples(problem.motion, rays, depth)
    video, samples = problem.video[rays.frame], depth.shape[1]
    distance = field.distance_at(
        points.view(-1, 3), video.repeat_interleave(samples), code_of.repeat_interleave(samples)
    ).view(-1, samples)
    target = (rays.depth[:, None] - depth) * rays.slope[:, None]
    target[:, 1 + NEAR :] = target[:, 1 + NEAR :].clamp_min(limit)
    color, feature = field.color_and_feature(field.encode(points[:, 0], video, code_of))
    terms = {
        "distance": (weights.distance, losses.truncated_distance(distance, target, limit)),
        "color": (weights.color, losses.color(color, rays.color / 255)),
        "feature": (weights.feature, losses.feature(feature, rays.feature / 127)),
    }
    if field.fused is None:
        few = slice(0, len(rays) // EIKONAL_SHARE)
        terms["eikonal"] = weights.eikonal, eikonal(field, points[few, 0].detach(), video[few], code_of[few])
    return terms


def eikonal(
    field: Field,
    points_world: Float[Tensor, "point 3"],
    video: Int[Tensor, "point"],
    code_of: Int[Tensor, "point"],
) -> Float[Tensor, "point"]:
    """Return the eikonal loss of the scene's field at points, by finite differences."""
    neighbors = points_world + EIKONAL_STEP_M * torch.eye(3, device=points_world.device)[:, None]
    distance = field.distance_at(points_world, video, code_of)
    shifted = field.distance_at(neighbors.reshape(-1, 3), video.repeat(3), code_of.repeat(3)).view(3, -1)
    return losses.eikonal(distance, shifted, EIKONAL_STEP_M)


def rendered_terms(
    problem: Problem,
    rays: Rays,
    code_of: Int[Tensor, "ray"],
    weights: LossWeights,
    depth: Float[Tensor, "ray sample"],
) -> Terms:
    """Return the volume rendering losses of rays with samples at ``depth``, meters."""
    points, length = world_samples(problem.motion, rays, depth)
    scene = scene_layer(problem, points, problem.video[rays.frame], code_of)
    rendered = composite(depth, length, scene)
    known = rays.depth > 0
    return {
        "rendered color": (weights.rendered_color, losses.color(rendered.color, rays.color / 255)),
        "rendered feature": (weights.rendered_feature, losses.feature(rendered.feature, rays.feature / 127)),
        "rendered depth": (weights.rendered_depth, losses.depth(rendered.depth, rays.depth)[known]),
    }


def scene_layer(
    problem: Problem,
    points: Float[Tensor, "ray sample 3"],
    video: Int[Tensor, "ray"],
    code_of: Int[Tensor, "ray"],
) -> Layer:
    """Evaluate the scene's field along rays with the geometry of ``video`` and the code ``code_of``."""
    field, (rays, samples) = problem.scene, points.shape[:2]
    values = field(
        points.reshape(-1, 3), video.repeat_interleave(samples), code_of.repeat_interleave(samples)
    )
    return Layer.of(field, values, (rays, samples))


def scene_density(
    problem: Problem,
    points: Float[Tensor, "ray sample 3"],
    video: Int[Tensor, "ray"],
    code_of: Int[Tensor, "ray"],
    min_beta_m: float = 0.0,
) -> Float[Tensor, "ray sample"]:
    """Return the scene's density along rays, per meter; arguments as of `scene_layer` and `Field.density`."""
    field, (rays, samples) = problem.scene, points.shape[:2]
    distance = field.distance_at(
        points.reshape(-1, 3), video.repeat_interleave(samples), code_of.repeat_interleave(samples)
    )
    return field.density(distance, min_beta_m).view(rays, samples)


def render_depths(
    rays: Rays, surface_m: Float[Tensor, "ray"], samples: int, generator: Generator
) -> Float[Tensor, "ray sample"]:
    """Place samples of rendered rays, z in meters: half around a surface, half before it."""
    end = surface_m[:, None]
    near = end + (strata(rays, samples // 2, generator) * 2 - 1) * REACH_M
    before = (end - REACH_M - RAY_START_M).clamp_min(0.01) * strata(rays, samples - samples // 2, generator)
    return torch.cat([RAY_START_M + before, near], dim=1).sort(dim=1).values


@torch.no_grad()
def surface_depths(
    rays: Rays,
    farthest_m: float,
    density_of: Callable[[Int[Tensor, "ray"], Float[Tensor, "ray sample"]], Float[Tensor, "ray sample"]],
    generator: Generator,
) -> Float[Tensor, "ray"]:
    """Return measured depth, and where it is unknown the z at which accumulated opacity reaches 0.5, meters.

    Args:
        rays: with or without measured depth.
        farthest_m: end of the `SEARCH_SAMPLES` uniform samples; returned for rays that hit nothing.
        density_of: density per meter of some of the rays, given by their indices, at z in meters.
        generator: random numbers of the stratified samples.
    """
    surface, unknown = rays.depth.clone(), torch.nonzero(rays.depth <= 0)[:, 0]
    if not len(unknown):
        return surface
    some = rays.at(unknown)
    depth = uniform_depths(some, farthest_m, SEARCH_SAMPLES, generator)
    weight = ray_weights(depth, some.direction.norm(dim=-1), density_of(unknown, depth))
    ended = weight.cumsum(-1) >= 0.5
    first = depth.gather(1, ended.int().argmax(-1, keepdim=True))[:, 0]
    surface[unknown] = torch.where(ended.any(-1), first, farthest_m)
    return surface


def uniform_depths(
    rays: Rays, farthest_m: float, samples: int, generator: Generator
) -> Float[Tensor, "ray sample"]:
    """Return stratified samples up to ``farthest_m``, z in meters."""
    return RAY_START_M + (farthest_m - RAY_START_M) * strata(rays, samples, generator)


def camera_prior(problem: Problem) -> Terms:
    """Return the priors on camera corrections: small where registration is certain, smooth across knots."""
    correction, knot = problem.motion.camera / CAMERA_M, torch.unique(problem.motion.knot)
    return {
        "drift": (DRIFT_WEIGHT, (correction[knot + 1] - correction[knot]).square()),
        "anchor": (ANCHOR_WEIGHT, problem.camera_precision[:, None] * correction.square()),
    }


class SceneLoss:
    """The loss of the first phase: scene and cameras, feature-metric loss included."""

    def __init__(
        self, problem: Problem, weights: LossWeights, batches: RayBatches, steps: int, rendered: bool = False
    ):
        """``steps``: of both phases, over which codes are annealed; ``rendered``: differentiable rendering
        alone, with uniform and importance samples (ATS, A.1).
        """
        self.problem, self.weights, self.batches, self.steps = problem, weights, batches, steps
        self.rendered = rendered
        self.measured = torch.nonzero(problem.store.scene.depth > 0)[:, 0].int()

    def __call__(self, step: int, generator: Generator) -> dict[str, Tensor]:
        probability = swap_probability(step / self.steps, self.batches)
        terms = self.terms(self.batches.scene_rays, probability, generator)
        return losses.weighted(terms | camera_prior(self.problem), shared=True)

    def terms(self, number: int, probability: float, generator: Generator) -> Terms:
        """Return the scene's terms over random rays; codes are swapped with a ``probability``."""
        if self.rendered:
            return self._rendered(number, probability, generator)
        problem, store, batches = self.problem, self.problem.store, self.batches
        rays = store.scene.at(self.measured[pick(len(self.measured), number, generator, problem.device)])
        others = store.scene.at(pick(len(store.scene), batches.rendered_rays // 2, generator, problem.device))
        videos = problem.scene.shape.videos
        code_of = swap_codes(problem.video[rays.frame], videos, probability, generator)
        other_code = swap_codes(problem.video[others.frame], videos, probability, generator)
        terms = measured_terms(problem, rays, code_of, self.weights, generator)

        def density_of(index: Tensor, depth: Tensor) -> Tensor:
            points, _ = world_samples(problem.motion, others.at(index), depth)
            return scene_density(problem, points, problem.video[others.frame[index]], other_code[index])

        surface = surface_depths(others, store.farthest_m, density_of, generator)
        depth = render_depths(others, surface, batches.rendered_samples, generator)
        return terms | rendered_terms(problem, others, other_code, self.weights, depth)

    def _rendered(self, number: int, probability: float, generator: Generator) -> Terms:
        problem, field = self.problem, self.problem.scene
        rays = problem.store.scene.at(pick(len(problem.store.scene), number, generator, problem.device))
        video = problem.video[rays.frame]
        code_of = swap_codes(video, field.shape.videos, probability, generator)
        half = self.batches.rendered_samples // 2
        coarse = uniform_depths(rays, problem.store.farthest_m, half, generator)
        spacing_m = problem.store.farthest_m / half
        with torch.no_grad():
            points, length = world_samples(problem.motion, rays, coarse)
            density_ = scene_density(problem, points, video, code_of, spacing_m / 2)
            fine = importance_depths(coarse, length, density_, generator)
        depth = torch.cat([coarse, fine], dim=1).sort(dim=1).values
        terms = rendered_terms(problem, rays, code_of, self.weights, depth)
        if not field.fused:
            chosen = torch.randint(depth.shape[1], (len(rays), 1), generator=generator).to(depth.device)
            place = world_samples(problem.motion, rays, depth.gather(1, chosen))[0][:, 0].detach()
            terms["eikonal"] = self.weights.eikonal, eikonal(field, place, video, code_of)
        return terms
