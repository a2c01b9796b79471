"""Fit the networks of long-term motion one after the other: static bodies, routes, then poses along routes that are held."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from torch import Tensor, nn

from pipeline.fit import FitRecord, fit
from pipeline.models.bodies import PosedSurface, PoseSpace
from pipeline.models.clip_channels import Clips
from pipeline.models.contacts import Contacts
from pipeline.models.longterm import ROOT, BaseNet, PoseNet, RouteNet, StaticBody, rotations_of
from pipeline.models.longterm_examples import Bodies, Lives
from stages.train_longterm import objectives


@dataclass(frozen=True)
class Pace:
    """Length and speed of one network's training."""

    steps: int = 500
    """steps of Adam"""
    batch: int = 48
    """examples a step"""
    rate: float = 2e-3
    """peak learning rate; falls to nothing along a cosine (the paper: 1e-3, and five to twenty times the steps)"""


@dataclass(frozen=True)
class Weights:
    """What the terms of the losses weigh."""

    translation: float = 1.0
    """lambda_t, per metre"""
    rotation: float = 1.0
    """lambda_r"""
    pose: float = 10.0
    """lambda_p, per metre of the bones"""
    divergence: float = 0.003
    """KL term of the CVAE"""
    vertices: float = 5.0
    """distance of the CVAE's mesh from the true one, per metre"""
    collision: float = 5.0
    """CVAE: depth inside the scene, per metre"""
    contact: float = 0.02
    """CVAE: contact vertices near the scene touch it"""


def cosine(progress: float) -> float:
    """Return the factor on the learning rate."""
    return min(1.0, (progress + 1e-3) / 0.03) * 0.5 * (1 + np.cos(np.pi * min(progress, 1.0))) + 1e-3


@dataclass(frozen=True)
class Trainer:
    """What all trainings share."""

    poses: PoseSpace
    weights: Weights
    seed: int
    resume: Path | None = None
    device: str = "cpu"

    def fitted(self, name: str, net: nn.Module, pace: Pace, loss: Callable[[Tensor], dict[str, Tensor]], examples: int) -> FitRecord:
        """Fit one network in place to random batches of examples."""
        optimizer = torch.optim.Adam(net.parameters(), lr=pace.rate)

        def step_loss(step: int, generator: torch.Generator) -> dict[str, Tensor]:
            return loss(torch.randint(examples, (pace.batch,), generator=generator))

        folder = self.resume / name if self.resume else None
        record = fit(
            modules={"net": net}, optimizer=optimizer, loss=step_loss, steps=pace.steps, seed=self.seed,
            resume=folder, save_every=200, schedule=cosine, label=name, clip_norm=1.0,
        )  # fmt: skip
        net.eval()
        return record


def fit_route(net: RouteNet, clips: Clips, trainer: Trainer, pace: Pace, name: str = "route") -> FitRecord:
    """Fit a RouteNet (Eq. 3), its draft alike."""
    w = trainer.weights

    def loss(index: Tensor) -> dict[str, Tensor]:
        truth = clips.channels[index]
        made = net.stages(truth[:, 0], truth[:, -1], clips.seen[index])
        shift, turn = map(sum, zip(*(objectives.route_error(each, truth) for each in made), strict=True))
        return {"translation": w.translation * shift} | ({"rotation": w.rotation * turn} if net.turns else {})

    return trainer.fitted(name, net, pace, loss, len(clips))


def made_routes(net: RouteNet, clips: Clips) -> Float[Tensor, "clip frame 9"]:
    """Return the routes that a RouteNet makes, which the paper's PoseNet learns along."""
    with torch.no_grad():
        ends, batches = clips.channels[:, [0, -1]], torch.arange(len(clips)).split(256)
        return torch.cat([net(ends[rows, 0], ends[rows, 1], clips.seen[rows]) for rows in batches])


def true_routes(clips: Clips, smooth_frames: float = 4.0) -> Float[Tensor, "clip frame 9"]:
    """Return the true routes, as smooth as made ones: along routes that are off, poses that fit none of them would be learned."""
    route = clips.channels[..., :ROOT]
    even = torch.from_numpy(gaussian_filter1d(route.numpy(), smooth_frames, axis=1, mode="nearest"))
    return rotations_of(torch.cat([route[:, :1], even[:, 1:-1], route[:, -1:]], dim=1))


def fit_pose(
    net: PoseNet, routes: Float[Tensor, "clip frame 9"], clips: Clips, trainer: Trainer, pace: Pace, name: str = "pose"
) -> FitRecord:
    """Fit a PoseNet along routes that are held (Eq. 4)."""
    w, lever = trainer.weights, objectives.lever_of(trainer.poses)

    def loss(index: Tensor) -> dict[str, Tensor]:
        truth = clips.channels[index]
        made = net(truth[:, 0, ROOT:], truth[:, -1, ROOT:], routes[index], clips.seen.points[index])
        terms = {"pose": w.pose * objectives.pose_error(made[..., ROOT:], truth[..., ROOT:], lever)}
        return terms | ({"rotation": w.rotation * objectives.route_error(made[..., :ROOT], truth[..., :ROOT])[1]} if net.turns else {})

    return trainer.fitted(name, net, pace, loss, len(clips))


def fit_base(net: BaseNet, clips: Clips, trainer: Trainer, pace: Pace, name: str = "base") -> FitRecord:
    """Fit a BaseNet, its draft alike."""
    w, lever = trainer.weights, objectives.lever_of(trainer.poses)

    def loss(index: Tensor) -> dict[str, Tensor]:
        truth = clips.channels[index]
        made = net.stages(truth[:, 0], truth[:, -1], clips.seen[index])
        shift, turn = map(sum, zip(*(objectives.route_error(each[..., :ROOT], truth[..., :ROOT]) for each in made), strict=True))
        pose = sum(objectives.pose_error(each[..., ROOT:], truth[..., ROOT:], lever) for each in made)
        return {"translation": w.translation * shift, "rotation": w.rotation * turn, "pose": w.pose * pose}

    return trainer.fitted(name, net, pace, loss, len(clips))


def fit_body(
    net: StaticBody, bodies: Bodies, lives: Lives, contacts: Contacts, trainer: Trainer, pace: Pace, vertices: int = 150, name: str = "body"
) -> FitRecord:
    """Fit the CVAE: reconstruction, KL divergence, contact and collision (Sec. 3.2)."""
    w, poses, lever = trainer.weights, trainer.poses, objectives.lever_of(trainer.poses)
    chosen = lives.body.spread(vertices)
    surface = PosedSurface(lives.body, np.concatenate([chosen, contacts.vertices]))
    frames = torch.from_numpy(bodies.places.world_from_place).float()
    scene, distances = torch.from_numpy(bodies.scene), [each.distance for each in lives.scenes]
    shape = torch.from_numpy(lives.body.shape).float()[None]

    def loss(index: Tensor) -> dict[str, Tensor]:
        truth = bodies.truth[index]
        given = net.given(bodies.places.place[index], shape.expand(len(index), -1), bodies.places.points[index])
        mean, log_variance = net.encode(truth, given)
        made = net.decode(mean + torch.randn_like(mean) * (log_variance / 2).exp(), given)
        mesh = objectives.posed(made, frames[index], poses, surface)
        with torch.no_grad():
            true_mesh = objectives.posed(truth, frames[index], poses, surface)
        shift, turn = objectives.route_error(made[..., :ROOT], truth[..., :ROOT])
        collision, contact = objectives.scene_errors(mesh, scene[index], distances, contacts, len(chosen))
        return {
            "root": w.translation * shift + w.rotation * turn,
            "pose": w.pose * objectives.pose_error(made[..., ROOT:], truth[..., ROOT:], lever),
            "vertices": w.vertices * (mesh - true_mesh).norm(dim=-1).mean(),
            "divergence": w.divergence * objectives.divergence(mean, log_variance),
            "collision": w.collision * collision,
            "contact": w.contact * contact,
        }

    return trainer.fitted(name, net, pace, loss, len(bodies.scene))
