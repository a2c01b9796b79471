"""Motion optimization for physical plausibility: no foot skate, no penetration, contact preserved.

`optimize_motion` optimizes positions, orientations and poses of all frames jointly with Adam (Wang et al.
2021, Sec. 3.4), for long-term motion, samples of the behavior model and reconstructed motion alike. World
frame, meters, radians.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from torch import Tensor

from pipeline.geometry import rigid_torch
from pipeline.geometry.signed_distance import SignedDistance
from pipeline.longterm.bodies import PosedSurface, PoseSpace, SkinnedBody
from pipeline.longterm.config import MotionOptimizationConfig
from pipeline.longterm.contacts import ContactVertices
from pipeline.longterm.plausibility import SOLID_M, PlausibilityMeter
from pipeline.longterm.short_motions import BodyMotion

LEARNING_RATE = 0.004
"""Initial learning rate of Adam, meters and radians."""
RATE_FALL = 0.9
"""Share of the learning rate by which it decays linearly over the optimization."""
LIFT_FRAMES = 4
"""Frames before and after a lifted one over which the lift fades in and out."""
HIGHEST_LIFT_M = 0.2
"""A vertex that needs a higher lift is in a wall and is not lifted."""
LIFT_STEP_M = 0.02
"""Step between candidate lifts."""
NEAR_M = 0.05
"""Feet of a static body within this distance of the scene are in stance."""
SETTLING_STEPS = 80
"""Steps for static bodies."""
FRAMES_AT_ONCE = 100
"""Frames per batch when the full surface is posed."""


@dataclass(frozen=True)
class MotionTerms:
    """Weights and scales of the terms; each term is a mean over frames, in meters or square meters."""

    foot: float = 5.0
    """E_foot: distance of a foot in stance from its mean position in that phase"""
    foot_tolerance_m: float = 0.002
    """smoothing of that distance near zero"""
    ground: float = 1.5
    """distance of a foot in stance from the scene"""
    collision: float = 60.0
    """E_col, Eq. 5: penetration depth, mean over vertices"""
    collision_growth: float = 0.05
    """growth of a frame's collision weight after each step of the second half with a colliding vertex; depth
    alone gives no direction where the body spans an object's whole width, like a tail across a chair leg"""
    deepest: float = 6.0
    """penetration depth of a frame's deepest vertex"""
    margin_m: float = 0.002
    """clearance from the scene below which a vertex collides"""
    contact: float = 0.02
    """E_cont, Eq. 6: robust distance of contact vertices from the scene"""
    contact_scale_m: float = 0.02
    """scale of the Geman-McClure function"""
    smooth: float = 180.0
    """E_smooth, Eq. 7: squared acceleration of vertices"""
    stay: float = 6.0
    """squared distance from the given motion"""


TERMS = MotionTerms()
"""The weights of every optimization."""


class _Correction(torch.nn.Module):
    """A motion with learnable corrections: translation and rotation of the root, and pose code."""

    def __init__(self, motion: BodyMotion, poses: PoseSpace):
        super().__init__()
        self.root, _ = motion.tensors()
        self.channels, self.poses = poses.channels(motion.agent_from_bone), poses
        self.shift = torch.nn.Parameter(torch.zeros(len(motion), 3))
        self.turn = torch.nn.Parameter(torch.zeros(len(motion), 3))
        self.pose = torch.nn.Parameter(torch.zeros(len(motion), len(poses.basis)))

    def forward(self) -> tuple[Float[Tensor, "frame 4 4"], Float[Tensor, "frame bone 4 4"]]:
        rotation = self.root[:, :3, :3] @ rigid_torch.so3_exp(self.turn)
        bones = self.poses.bones(self.channels + self.pose @ self.poses.basis)
        return rigid_torch.make(rotation, self.root[:, :3, 3] + self.shift), bones


def optimize_motion(
    motion: BodyMotion,
    meter: PlausibilityMeter,
    poses: PoseSpace,
    settings: MotionOptimizationConfig,
    *,
    held: Bool[np.ndarray, "frame"] | None = None,
) -> BodyMotion:
    """Return the motion that minimizes the weighted sum of all terms in the scene and for the body of
    ``meter``; ``held`` frames are fixed.
    """
    stance = meter.stance(motion, should_stand=True)
    free = torch.ones(len(motion)) if held is None else torch.from_numpy(~held).float()
    return _minimize(motion, meter, poses, settings, TERMS, stance, free, reach=LIFT_FRAMES)


def settle_bodies(bodies: BodyMotion, meter: PlausibilityMeter, poses: PoseSpace) -> BodyMotion:
    """Move static bodies, each independently, out of collision and into contact with the ground."""
    feet = PosedSurface(meter.body, meter.contacts.vertices)(*bodies.tensors())
    near = meter.contacts.lowest(meter.scene.at(feet)).numpy() < NEAR_M
    settings, terms = MotionOptimizationConfig(steps=SETTLING_STEPS), replace(TERMS, foot=0.0, smooth=0.0)
    return _minimize(bodies, meter, poses, settings, terms, near, torch.ones(len(bodies)), reach=0)


def _minimize(
    motion: BodyMotion,
    meter: PlausibilityMeter,
    poses: PoseSpace,
    settings: MotionOptimizationConfig,
    terms: MotionTerms,
    stance: Bool[np.ndarray, "frame foot"],
    free: Float[Tensor, "frame"],
    *,
    reach: int,
) -> BodyMotion:
    body, contacts, scene = meter.body, meter.contacts, meter.scene
    chosen = body.sample_vertices(settings.vertices)
    sampled = np.concatenate([chosen, contacts.vertices])
    surface, both = PosedSurface(body, sampled), len(sampled)
    correction = _Correction(motion, poses)
    with torch.no_grad():
        given = surface(*correction())
        correction.shift[:, 1] += free * lift_out_of_solid(given[:, len(chosen) :], scene, reach=reach)
    objective = _Objective(contacts, terms, phase_means(stance), len(chosen), given)
    weight = torch.ones(len(motion), 1)
    optimizer = torch.optim.Adam(correction.parameters(), lr=LEARNING_RATE)
    for step in range(settings.steps):
        for group in optimizer.param_groups:
            group["lr"] = LEARNING_RATE * (1 - RATE_FALL * step / settings.steps)
        if step in (settings.steps // 2, 3 * settings.steps // 4):
            inside = _penetrating_vertices(body, correction, scene, both)
            surface = PosedSurface(body, np.concatenate([sampled, inside]))
        points = surface(*correction())
        distance = scene.at(points)
        if step >= settings.steps // 2:
            deep = (-distance.detach()).amax(dim=1, keepdim=True) > SOLID_M
            weight = weight * (1 + terms.collision_growth * deep)
        optimizer.zero_grad(set_to_none=True)
        objective(points, distance, weight).backward()
        for parameter in correction.parameters():
            if parameter.grad is not None:
                parameter.grad *= free[:, None]
        optimizer.step()
    with torch.no_grad():
        root, bones = correction()
    return BodyMotion(root.double().numpy(), bones.double().numpy())


@dataclass(frozen=True)
class _Objective:
    """The weighted sum of all terms."""

    contacts: ContactVertices
    terms: MotionTerms
    phases: tuple[Tensor, Tensor]
    count: int
    """number of surface vertices; the contact vertices follow them"""
    given: Float[Tensor, "frame vertex 3"]

    def __call__(
        self,
        points: Float[Tensor, "frame vertex 3"],
        distance: Float[Tensor, "frame vertex"],
        collision_weight: Float[Tensor, "frame 1"],
    ) -> Float[Tensor, ""]:
        terms, both = self.terms, self.given.shape[1]
        feet = self.contacts.centers(points[:, self.count : both])
        near = distance[:, self.count : both]
        inside = collision_error(distance, terms.margin_m)
        smooth = sum(_mean(smooth_error(each)) for each in (points[:, : self.count], feet))
        return (
            terms.foot * _mean(foot_error(feet, self.phases, terms.foot_tolerance_m))
            + terms.ground * _mean(self.contacts.lowest(near).flatten()[self.phases[0]].abs())
            + terms.collision * (collision_weight * inside).mean()
            + terms.deepest * inside.amax(dim=1).mean()
            + terms.contact * contact_error(near, terms.contact_scale_m).mean()
            + terms.smooth * smooth
            + terms.stay * ((points[:, :both] - self.given) ** 2).sum(-1).mean()
        )


@torch.no_grad()
def _penetrating_vertices(
    body: SkinnedBody, correction: _Correction, scene: SignedDistance, most: int
) -> Int[np.ndarray, "vertex"]:
    """Return up to about ``most`` vertices of the full surface that penetrate the scene in any frame."""
    surface, deepest = PosedSurface(body), torch.full((len(body.mesh.vertices),), np.inf)
    for root, bones in zip(*(each.split(FRAMES_AT_ONCE) for each in correction()), strict=True):
        deepest = torch.minimum(deepest, scene.at(surface(root, bones)).amin(dim=0))
    found = np.flatnonzero(deepest.numpy() < -SOLID_M)
    return found[:: max(1, int(np.ceil(len(found) / most)))]


def _mean(values: Tensor) -> Tensor:
    return values.sum() / max(values.numel(), 1)


def lift_out_of_solid(
    touching: Float[Tensor, "frame vertex 3"], scene: SignedDistance, *, reach: int
) -> Float[Tensor, "frame"]:
    """Return the upward shift of each frame that brings penetrating contact vertices above the surface.

    The distance gradient leads to the nearest side, which for a thin board is often the lower one. Vertices
    that need more than `HIGHEST_LIFT_M` are ignored. Lifts fade in and out over ``reach`` frames.
    """
    heights = torch.arange(0, HIGHEST_LIFT_M, LIFT_STEP_M)
    up = torch.tensor([0.0, 1.0, 0.0])
    inside = torch.stack([scene.at(touching + height * up) < 0 for height in heights])  # height frame vertex
    first = torch.where(inside.all(0), 0, (~inside).float().argmax(0))
    needed = heights[first].amax(1).numpy()
    if reach:
        needed = ndimage.maximum_filter1d(needed, 2 * reach + 1, mode="nearest")
        needed = ndimage.gaussian_filter1d(needed, reach, mode="nearest")
    return torch.from_numpy(needed)


def phase_means(stance: Bool[np.ndarray, "frame foot"]) -> tuple[Int[Tensor, "stand"], Int[Tensor, "stand"]]:
    """Return the flat indices of (frame, foot) in stance, and the index of the phase of each."""
    starts = stance & ~np.concatenate([np.zeros_like(stance[:1]), stance[:-1]])
    number = np.cumsum(starts.T.reshape(-1)).reshape(stance.T.shape).T  # counts along one foot, then the next
    flat = np.flatnonzero(stance.reshape(-1))
    return torch.from_numpy(flat), torch.from_numpy(number.reshape(-1)[flat] - 1)


def foot_error(
    feet: Float[Tensor, "frame foot 3"],
    phases: tuple[Int[Tensor, "stand"], Int[Tensor, "stand"]],
    tolerance_m: float,
) -> Float[Tensor, "stand"]:
    """Return the distance of each foot in stance from its phase's mean position (E_foot), smooth at zero.

    Not squared, so that feet come to rest exactly.
    """
    flat, phase = phases
    points = feet.flatten(0, 1)[flat]
    count = torch.bincount(phase).to(points)[:, None]
    mean = torch.zeros(len(count), 3).index_add(0, phase, points) / count
    return (((points - mean[phase]) ** 2).sum(-1) + tolerance_m**2).sqrt() - tolerance_m


def collision_error(distance_m: Float[Tensor, "*vertex"], margin_m: float) -> Float[Tensor, "*vertex"]:
    """Return the depth of each vertex inside the scene or its margin, meters (E_col, Eq. 5)."""
    return (margin_m - distance_m).clamp_min(0)


def contact_error(distance_m: Float[Tensor, "*vertex"], scale_m: float) -> Float[Tensor, "*vertex"]:
    """Return the Geman-McClure function of the distance to the scene (E_cont, Eq. 6)."""
    square = distance_m**2
    return square / (square + scale_m**2)


def smooth_error(points: Float[Tensor, "frame vertex 3"]) -> Float[Tensor, "change vertex"]:
    """Return the squared second difference of vertices over frames, square meters (E_smooth, Eq. 7).

    The paper takes the first difference, which also slows the body down.
    """
    step = points[1:] - points[:-1]
    return ((step[1:] - step[:-1]) ** 2).sum(-1)
