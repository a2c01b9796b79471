"""Make a motion physical: standing feet do not slide, nothing is inside furniture, what touches keeps
touching.

`optimize_motion` moves positions, orientations and poses of all frames at once by Adam (Wang et al. 2021,
Sec. 3.4). The same function with the same `MotionOptimizationConfig` serves long-term motion, samples of the
behaviour model and reconstructed motion. World frame, metres, radians.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from torch import Tensor

from pipeline.behavior.model import channels_from_bones
from pipeline.geometry import rigid_torch
from pipeline.geometry.signed_distance import SignedDistance
from pipeline.longterm.bodies import PosedSurface, PoseSpace, SkinnedBody
from pipeline.longterm.config import MotionOptimizationConfig
from pipeline.longterm.contacts import ContactVertices, motion_tensors
from pipeline.longterm.plausibility import SOLID_M, PlausibilityMeter
from pipeline.longterm.short_motions import BodyMotion

LEARNING_RATE = 0.004
"""Of Adam, metres and radians a step; it falls to a tenth over the optimisation."""
RATE_FALL = 0.9
"""Share of the learning rate that is lost over the optimisation, linearly."""
LIFT_FRAMES = 4
"""Frames before and after one that must be lifted in which the motion rises and sinks."""
HIGHEST_LIFT_M = 0.2
"""What has no way up within this is a wall, and the body is not lifted over it."""
LIFT_STEP_M = 0.02
"""Heights at which a way up is looked for."""
NEAR_M = 0.05
"""Feet of a single body that are no further than this from the scene stand on it."""
SETTLING_STEPS = 80
"""Steps that are enough for single bodies."""
FRAMES_AT_ONCE = 100
"""In so many frames at a time the whole surface is looked at."""


@dataclass(frozen=True)
class MotionTerms:
    """Weights and scales of the terms; each term is a mean over frames, in metres or square metres."""

    foot: float = 5.0
    """E_foot: a standing foot stays where it stands on average"""
    foot_tolerance_m: float = 0.002
    """nearer than this to that place the pull on the foot fades"""
    ground: float = 1.5
    """a standing foot touches what it stands on"""
    collision: float = 60.0
    """E_col, Eq. 5: nothing is inside the scene, on average over vertices"""
    collision_growth: float = 0.05
    """growth of a frame's collision weight after each step of the second half that leaves a vertex inside;
    the deepest vertex says nothing where a thing's whole breadth is covered, as a tail over a chair's leg"""
    deepest: float = 6.0
    """the deepest vertex of a frame is not inside the scene either"""
    margin_m: float = 0.002
    """distance kept from what is solid"""
    contact: float = 0.02
    """E_cont, Eq. 6: contact vertices near the scene touch it"""
    contact_scale_m: float = 0.02
    """distance at which the Geman-McClure function lets go"""
    smooth: float = 180.0
    """E_smooth, Eq. 7: neighbouring meshes change evenly"""
    stay: float = 6.0
    """stay near the motion that was given"""


TERMS = MotionTerms()
"""What every optimisation uses."""


@dataclass(frozen=True)
class ContactBody:
    """What a body brings to the optimisation: surface, contacts, and a space of poses."""

    body: SkinnedBody
    contacts: ContactVertices
    poses: PoseSpace


class _Correction(torch.nn.Module):
    """A motion and what is added to it: shift and turn of the root, and p of the pose."""

    def __init__(self, moving: BodyMotion, poses: PoseSpace):
        super().__init__()
        self.root, _ = motion_tensors(moving)
        bones, rest = np.asarray(moving.agent_from_bone, np.float64), poses.rest.double().numpy()
        self.channels = torch.from_numpy(channels_from_bones(bones, rest)).float()
        self.poses = poses
        self.shift = torch.nn.Parameter(torch.zeros(len(moving), 3))
        self.turn = torch.nn.Parameter(torch.zeros(len(moving), 3))
        self.pose = torch.nn.Parameter(torch.zeros(len(moving), poses.components))

    def forward(self) -> tuple[Float[Tensor, "frame 4 4"], Float[Tensor, "frame bone 4 4"]]:
        rotation = self.root[:, :3, :3] @ rigid_torch.so3_exp(self.turn)
        bones = self.poses.bones(self.channels + self.pose @ self.poses.basis)
        return rigid_torch.make(rotation, self.root[:, :3, 3] + self.shift), bones


def optimize_motion(
    moving: BodyMotion,
    contact_body: ContactBody,
    scene: SignedDistance,
    settings: MotionOptimizationConfig,
    *,
    held: Bool[np.ndarray, "frame"] | None = None,
) -> BodyMotion:
    """Return the motion with all constraints weighed against each other; ``held`` frames stay as they are."""
    meter = PlausibilityMeter(contact_body.body, contact_body.contacts, scene)
    stance = meter.stance(moving, should_stand=True)
    free = torch.ones(len(moving)) if held is None else torch.from_numpy(~held).float()
    return _minimize(moving, contact_body, scene, settings, TERMS, stance, free, reach=LIFT_FRAMES)


def settle_bodies(
    bodies: BodyMotion, contact_body: ContactBody, scene: SignedDistance, settings: MotionOptimizationConfig
) -> BodyMotion:
    """Move single bodies, each on its own, out of what is solid and onto what is under their feet."""
    with torch.no_grad():
        feet = PosedSurface(contact_body.body, contact_body.contacts.vertices)(*motion_tensors(bodies))
        near = contact_body.contacts.lowest(scene.at(feet)).numpy() < NEAR_M
    alone = replace(settings, steps=min(settings.steps, SETTLING_STEPS))
    terms = replace(TERMS, foot=0.0, smooth=0.0)
    return _minimize(bodies, contact_body, scene, alone, terms, near, torch.ones(len(bodies)), reach=0)


def _minimize(
    moving: BodyMotion,
    contact_body: ContactBody,
    scene: SignedDistance,
    settings: MotionOptimizationConfig,
    terms: MotionTerms,
    stance: Bool[np.ndarray, "frame foot"],
    free: Float[Tensor, "frame"],
    *,
    reach: int,
) -> BodyMotion:
    body, contacts = contact_body.body, contact_body.contacts
    chosen = body.sample_vertices(settings.vertices)
    watched = np.concatenate([chosen, contacts.vertices])
    surface, both = PosedSurface(body, watched), len(watched)
    correction = _Correction(moving, contact_body.poses)
    with torch.no_grad():
        given = surface(*correction())
        correction.shift[:, 1] += free * lift_out_of_solid(given[:, len(chosen) :], scene, reach=reach)
    objective = _Objective(contacts, terms, phase_means(stance), len(chosen), given)
    weight = torch.ones(len(moving), 1)
    optimizer = torch.optim.Adam(correction.parameters(), lr=LEARNING_RATE)
    for step in range(settings.steps):
        for group in optimizer.param_groups:
            group["lr"] = LEARNING_RATE * (1 - RATE_FALL * step / settings.steps)
        if step in (settings.steps // 2, 3 * settings.steps // 4):
            inside = _penetrating_vertices(body, correction, scene, both)
            surface = PosedSurface(body, np.concatenate([watched, inside]))
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
    """of sampled vertices, which come first; the contact vertices follow"""
    given: Float[Tensor, "frame vertex 3"]

    def __call__(
        self,
        points: Float[Tensor, "frame vertex 3"],
        distance: Float[Tensor, "frame vertex"],
        collision_weight: Float[Tensor, "frame 1"],
    ) -> Float[Tensor, ""]:
        terms, both = self.terms, self.given.shape[1]
        feet = self.contacts.centres(points[:, self.count : both])
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
    """Return up to about ``most`` vertices of the surface that are inside the scene in any frame."""
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
    """Return how far to raise each frame for contact vertices that are inside of something to come out on
    top.

    The distance alone leads out on the nearest side: from a thin board often downwards. What has no way up
    within `HIGHEST_LIFT_M` is a wall. Rising and sinking is spread over ``reach`` frames on both sides.
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
    """Return which (frame, foot) stand, flat, and the number of the phase that each belongs to."""
    began = stance & ~np.concatenate([np.zeros_like(stance[:1]), stance[:-1]])
    number = np.cumsum(began.T.reshape(-1)).reshape(stance.T.shape).T  # counts along one foot after the other
    flat = np.flatnonzero(stance.reshape(-1))
    return torch.from_numpy(flat), torch.from_numpy(number.reshape(-1)[flat] - 1)


def foot_error(
    feet: Float[Tensor, "frame foot 3"],
    phases: tuple[Int[Tensor, "stand"], Int[Tensor, "stand"]],
    give_m: float,
) -> Float[Tensor, "stand"]:
    """Return the distance of each standing foot from its mean place in that phase (E_foot), even at nothing.

    A distance and not its square, as in the paper: a foot is then at one place, not only near it.
    """
    flat, phase = phases
    points = feet.flatten(0, 1)[flat]
    count = torch.bincount(phase).to(points)[:, None]
    mean = torch.zeros(len(count), 3).index_add(0, phase, points) / count
    return (((points - mean[phase]) ** 2).sum(-1) + give_m**2).sqrt() - give_m


def collision_error(distance_m: Float[Tensor, "*vertex"], margin_m: float) -> Float[Tensor, "*vertex"]:
    """Return how deep each vertex is inside the scene or its margin, metres (E_col, Eq. 5)."""
    return (margin_m - distance_m).clamp_min(0)


def contact_error(distance_m: Float[Tensor, "*vertex"], scale_m: float) -> Float[Tensor, "*vertex"]:
    """Return the Geman-McClure function of the distance to the scene (E_cont, Eq. 6)."""
    square = distance_m**2
    return square / (square + scale_m**2)


def smooth_error(points: Float[Tensor, "frame vertex 3"]) -> Float[Tensor, "change vertex"]:
    """Return the squared change of the difference between neighbouring meshes, square metres (E_smooth, Eq.
    7).

    The paper takes the difference itself, which also slows the body down.
    """
    step = points[1:] - points[:-1]
    return ((step[1:] - step[:-1]) ** 2).sum(-1)
