"""Make a motion physical: feet that stand or should do not slide, nothing is inside furniture, what touches keeps touching.

`optimise` moves positions, orientations and poses of all frames at once by Adam (Wang et al. 2021, Sec. 3.4). The same
function with the same `Settings` serves long-term motion, samples of the behaviour model and reconstructed motion.
"""

from dataclasses import dataclass, replace
from typing import Literal, assert_never

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from torch import Tensor

from pipeline.models.behavior import channels_from_bones
from pipeline.models.bodies import Body, PosedSurface, PoseSpace
from pipeline.models.contacts import Contacts, tensors
from pipeline.models.plausibility import SOLID_M, Judge
from pipeline.models.short_motions import RATE_HZ, Moving
from pipeline.space import rigid_torch
from pipeline.space.signed_distance import SignedDistance

LIFTED = 4
"""Frames before and after one that must be lifted in which the motion rises and sinks."""
NEAR_M = 0.05
"""Feet of a single body that are no further than this from the scene stand on it."""
SETTLING = 80
"""Steps that are enough for single bodies."""
FRAMES_AT_ONCE = 100
"""In so many frames at a time the whole surface is looked at."""


@dataclass(frozen=True)
class Settings:
    """Weights and length of the optimisation; every term is a mean over frames, in metres or square metres."""

    steps: int = 200
    """steps of Adam"""
    rate: float = 0.004
    """learning rate, metres and radians a step; falls to a tenth"""
    foot: float = 5.0
    """a standing foot stays where it stands on average"""
    give_m: float = 0.002
    """nearer than this to that place the pull on it fades"""
    ground: float = 1.5
    """a standing foot touches what it stands on"""
    collision: float = 60.0
    """nothing is inside the scene, on average over vertices"""
    growth: float = 0.05
    """how much more a frame's collision counts after each step of the second half in which any vertex is still in what is solid;
    the deepest alone says nothing where all of a thing's breadth is covered, as when a tail meets a chair's leg"""
    deepest: float = 6.0
    """nor is the deepest vertex of any frame"""
    contact: float = 0.02
    """contact vertices near the scene touch it"""
    contact_scale_m: float = 0.02
    """distance at which the Geman-McClure function lets go"""
    smooth: float = 180.0
    """neighbouring meshes"""
    smoothness: Literal["acceleration", "velocity"] = "acceleration"
    """what is kept small between neighbouring meshes; the paper's is the velocity, which also slows the animal down"""
    stay: float = 6.0
    """stay near the motion that was given"""
    vertices: int = 300
    """vertices of the surface that collision and smoothness look at"""
    margin_m: float = 0.002
    """keep this far off what is solid"""


@dataclass(frozen=True)
class Physique:
    """What a body brings to the optimisation: surface, contacts, and the directions in which its pose may move."""

    body: Body
    contacts: Contacts
    poses: PoseSpace


class _Correction(torch.nn.Module):
    """A motion and what is added to it: shift and turn of the root, and p of the pose."""

    def __init__(self, moving: Moving, poses: PoseSpace):
        super().__init__()
        self.root, _ = tensors(moving)
        rest = poses.rest.double().numpy()
        self.channels = torch.from_numpy(channels_from_bones(np.asarray(moving.agent_from_bone, np.float64), rest)).float()
        self.poses = poses
        self.shift = torch.nn.Parameter(torch.zeros(len(moving), 3))
        self.turn = torch.nn.Parameter(torch.zeros(len(moving), 3))
        self.pose = torch.nn.Parameter(torch.zeros(len(moving), poses.components))

    def forward(self) -> tuple[Float[Tensor, "frame 4 4"], Float[Tensor, "frame bone 4 4"]]:
        rotation = self.root[:, :3, :3] @ rigid_torch.so3_exp(self.turn)
        bones = self.poses.bones(self.channels + self.pose @ self.poses.basis)
        return rigid_torch.make(rotation, self.root[:, :3, 3] + self.shift), bones


def optimise(
    moving: Moving,
    physique: Physique,
    scene: SignedDistance,
    settings: Settings,
    *,
    rate_hz: float = RATE_HZ,
    held: Bool[np.ndarray, "frame"] | None = None,
) -> Moving:
    """Return the motion with all constraints weighed against each other; ``held`` frames stay as they are."""
    stance = Judge(physique.body, physique.contacts, scene).stance(moving, rate_hz, treading=True)
    free = torch.ones(len(moving)) if held is None else torch.from_numpy(~held).float()
    return _descended(moving, physique, scene, settings, stance, free, reach=LIFTED)


def settled(bodies: Moving, physique: Physique, scene: SignedDistance, settings: Settings) -> Moving:
    """Move single bodies, each on its own, out of what is solid and onto what is under their feet."""
    with torch.no_grad():
        feet = PosedSurface(physique.body, physique.contacts.vertices)(*tensors(bodies))
        near = physique.contacts.lowest(scene.at(feet)).numpy() < NEAR_M
    alone = replace(settings, foot=0.0, smooth=0.0, steps=min(settings.steps, SETTLING))
    return _descended(bodies, physique, scene, alone, near, torch.ones(len(bodies)), reach=0)


def _descended(
    moving: Moving,
    physique: Physique,
    scene: SignedDistance,
    settings: Settings,
    stance: Bool[np.ndarray, "frame foot"],
    free: Float[Tensor, "frame"],
    *,
    reach: int,
) -> Moving:
    chosen = physique.body.spread(settings.vertices)
    count = len(chosen)
    watched = np.concatenate([chosen, physique.contacts.vertices])
    surface, both = PosedSurface(physique.body, watched), len(watched)
    correction = _Correction(moving, physique.poses)
    phases = phase_means(stance)
    with torch.no_grad():
        given = surface(*correction())
        correction.shift[:, 1] += free * lift(given[:, count:], scene, reach=reach)
    pressure = torch.ones(len(moving), 1)
    optimizer = torch.optim.Adam(correction.parameters(), lr=settings.rate)
    for step in range(settings.steps):
        for group in optimizer.param_groups:
            group["lr"] = settings.rate * (1 - 0.9 * step / settings.steps)
        if step in (settings.steps // 2, 3 * settings.steps // 4):
            surface = PosedSurface(physique.body, np.concatenate([watched, _inside(physique.body, correction, scene, both)]))
        points = surface(*correction())
        distance = scene.at(points)
        feet, inside = physique.contacts.centres(points[:, count:both]), collision_error(distance, settings.margin_m)
        if step >= settings.steps // 2:
            pressure = pressure * (1 + settings.growth * (inside.detach().amax(dim=1, keepdim=True) > settings.margin_m + SOLID_M))
        total = (
            settings.foot * _mean(foot_error(feet, phases, settings.give_m))
            + settings.ground * _mean(physique.contacts.lowest(distance[:, count:both]).flatten()[phases[0]].abs())
            + settings.collision * (pressure * inside).mean()
            + settings.deepest * inside.amax(dim=1).mean()
            + settings.contact * contact_error(distance[:, count:both], settings.contact_scale_m).mean()
            + settings.smooth * sum(_mean(smooth_error(each, settings.smoothness)) for each in (points[:, :count], feet))
            + settings.stay * ((points[:, :both] - given) ** 2).sum(-1).mean()
        )
        optimizer.zero_grad(set_to_none=True)
        total.backward()
        for parameter in correction.parameters():
            parameter.grad *= free[:, None]
        optimizer.step()
    with torch.no_grad():
        root, bones = correction()
    return Moving(root.double().numpy(), bones.double().numpy())


@torch.no_grad()
def _inside(body: Body, correction: _Correction, scene: SignedDistance, most: int) -> Int[np.ndarray, "vertex"]:
    """Return vertices of the whole surface that are inside the scene in any frame, evenly left out beyond ``most``."""
    surface, deepest = PosedSurface(body), torch.full((len(body.mesh.vertices),), np.inf)
    for root, bones in zip(*(each.split(FRAMES_AT_ONCE) for each in correction()), strict=True):
        deepest = torch.minimum(deepest, scene.at(surface(root, bones)).amin(dim=0))
    found = np.flatnonzero(deepest.numpy() < -SOLID_M)
    return found[:: max(1, int(np.ceil(len(found) / most)))]


def _mean(values: Tensor) -> Tensor:
    return values.sum() / max(values.numel(), 1)


def lift(
    touching: Float[Tensor, "frame vertex 3"], scene: SignedDistance, *, reach: int, most_m: float = 0.2, step_m: float = 0.02
) -> Float[Tensor, "frame"]:
    """Return how far to raise each frame for contact vertices that are inside of something to come out on top.

    The distance alone leads out on the nearest side: from a thin board often downwards. What is no way up within ``most_m`` is a
    wall. Rising and sinking is spread over ``reach`` frames on both sides.
    """
    heights = torch.arange(0, most_m, step_m)
    inside = torch.stack([scene.at(touching + height * torch.tensor([0.0, 1.0, 0.0])) < 0 for height in heights])  # height frame vertex
    first = torch.where(inside.all(0), 0, (~inside).float().argmax(0))
    needed = heights[first].amax(1).numpy()
    if reach:
        needed = ndimage.gaussian_filter1d(ndimage.maximum_filter1d(needed, 2 * reach + 1, mode="nearest"), reach, mode="nearest")
    return torch.from_numpy(needed)


def phase_means(stance: Bool[np.ndarray, "frame foot"]) -> tuple[Tensor, Tensor]:
    """Return which (frame, foot) stand, flat, and the number of the phase that each belongs to."""
    began = stance & ~np.concatenate([np.zeros_like(stance[:1]), stance[:-1]])
    number = np.cumsum(began.T.reshape(-1)).reshape(stance.T.shape).T  # counts along one foot after the other
    flat = np.flatnonzero(stance.reshape(-1))
    return torch.from_numpy(flat), torch.from_numpy(number.reshape(-1)[flat] - 1)


def foot_error(feet: Float[Tensor, "frame foot 3"], phases: tuple[Tensor, Tensor], give_m: float) -> Float[Tensor, "stand"]:
    """Return the distance of each standing foot from its mean place in that phase (E_foot), even at nothing.

    A distance and not its square, as in the paper: a foot is then at one place, not only near it.
    """
    flat, phase = phases
    points = feet.flatten(0, 1)[flat]
    count = torch.bincount(phase).to(points)[:, None]
    mean = torch.zeros(len(count), 3).index_add(0, phase, points) / count
    return (((points - mean[phase]) ** 2).sum(-1) + give_m**2).sqrt() - give_m


def collision_error(distance_m: Float[Tensor, "frame vertex"], margin_m: float) -> Float[Tensor, "frame vertex"]:
    """Return how deep each vertex is inside the scene or its margin, given its distance from the scene (E_col, Eq. 5)."""
    return (margin_m - distance_m).clamp_min(0)


def contact_error(distance_m: Float[Tensor, "frame vertex"], scale_m: float) -> Float[Tensor, "frame vertex"]:
    """Return the Geman-McClure function of the distance to the scene (E_cont, Eq. 6)."""
    square = distance_m**2
    return square / (square + scale_m**2)


def smooth_error(points: Float[Tensor, "frame vertex 3"], kind: Literal["acceleration", "velocity"]) -> Float[Tensor, "frame vertex"]:
    """Return the squared difference between neighbouring meshes (E_smooth, Eq. 7), or the change of that difference."""
    step = points[1:] - points[:-1]
    match kind:
        case "velocity":
            return (step**2).sum(-1)
        case "acceleration":
            return ((step[1:] - step[:-1]) ** 2).sum(-1)
        case _:
            assert_never(kind)
