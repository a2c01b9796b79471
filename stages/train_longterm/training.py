"""Fit the networks of long-term motion in turn: static bodies, routes, then poses along fixed routes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d
from torch import Tensor, nn

from pipeline.core import distributed
from pipeline.core.training import FitRecord, fit
from pipeline.longterm.bodies import PosedSurface, PoseSpace
from pipeline.longterm.clip_channels import Clips
from pipeline.longterm.config import LongTermOptimizerConfig
from pipeline.longterm.contacts import ContactVertices
from pipeline.longterm.examples import MotionDataset, StaticBodies
from pipeline.longterm.networks import ROOT_CHANNELS, BaseNet, PoseNet, RouteNet, StaticBody, orthonormalized
from stages.train_longterm import objectives

GRADIENT_NORM = 1.0
"""Gradients longer than this are clipped to it."""
SAVE_EVERY = 200
"""Steps between checkpoints: a minute at most is lost when training is stopped."""
SMOOTH_FRAMES = 4.0
"""Deviation of the Gaussian that makes true routes as smooth as predicted ones, frames of 30 fps."""
CHUNK = 256
"""Clips at a time where nothing is trained."""
BODY_VERTICES = 150
"""Vertices of the surface that the CVAE's losses look at."""
MIN_RATE = 1e-3
"""Share of the peak learning rate at both ends."""
WARMUP = 0.03
"""Share of the training in which the learning rate rises."""


@dataclass(frozen=True)
class LongTermLossWeights:
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
    """Return the factor on the learning rate: a linear warm-up, then a cosine; never quite 0."""
    warm = min(1.0, (progress + MIN_RATE) / WARMUP)
    return warm * 0.5 * (1 + np.cos(np.pi * min(progress, 1.0))) + MIN_RATE


@dataclass(frozen=True)
class NetworkTrainer:
    """What all trainings share."""

    poses: PoseSpace
    weights: LongTermLossWeights
    seed: int
    resume: Path | None = None
    device: str = "cpu"

    def fitted(
        self,
        name: str,
        net: nn.Module,
        optimizer_config: LongTermOptimizerConfig,
        loss: Callable[[Int[Tensor, "batch"]], dict[str, Float[Tensor, ""]]],
        examples: int,
    ) -> FitRecord:
        """Fit one network in place to random batches of examples, which several processes share."""
        optimizer = torch.optim.Adam(net.parameters(), lr=optimizer_config.rate)

        def step_loss(step: int, generator: torch.Generator) -> dict[str, Tensor]:
            batch = distributed.share(optimizer_config.batch)
            return loss(torch.randint(examples, (batch,), generator=generator))

        folder = self.resume / name if self.resume else None
        record = fit(
            modules={"net": net},
            optimizer=optimizer,
            loss=step_loss,
            steps=optimizer_config.steps,
            seed=self.seed,
            resume=folder,
            save_every=SAVE_EVERY,
            schedule=cosine,
            label=name,
            clip_norm=GRADIENT_NORM,
            shared=True,
        )
        net.eval()
        return record


def fit_route(
    net: RouteNet,
    clips: Clips,
    trainer: NetworkTrainer,
    optimizer_config: LongTermOptimizerConfig,
    name: str = "route",
) -> FitRecord:
    """Fit a RouteNet (Eq. 3), its draft alike."""
    w = trainer.weights

    def loss(index: Tensor) -> dict[str, Tensor]:
        truth = clips.channels[index]
        made = net.stages(truth[:, 0], truth[:, -1], clips.seen[index])
        shift, turn = _summed_route_errors(made, truth)
        terms = {"translation": w.translation * shift}
        return terms | ({"rotation": w.rotation * turn} if net.predicts_rotation else {})

    return trainer.fitted(name, net, optimizer_config, loss, len(clips))


def _summed_route_errors(
    made: Sequence[Float[Tensor, "clip frame channel"]], truth: Float[Tensor, "clip frame known"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return translation and rotation error of a route, its draft's added."""
    errors = [objectives.route_error(each, truth) for each in made]
    shift, turn = (sum(parts, start=torch.zeros(())) for parts in zip(*errors, strict=True))
    return shift, turn


def predicted_routes(net: RouteNet, clips: Clips) -> Float[Tensor, "clip frame 9"]:
    """Return the routes that a RouteNet makes, which the paper's PoseNet learns along."""
    with torch.no_grad():
        ends, batches = clips.channels[:, [0, -1]], torch.arange(len(clips)).split(CHUNK)
        return torch.cat([net(ends[rows, 0], ends[rows, 1], clips.seen[rows]) for rows in batches])


def smoothed_true_routes(clips: Clips) -> Float[Tensor, "clip frame 9"]:
    """Return the true routes, as smooth as predicted ones."""
    route = clips.channels[..., :ROOT_CHANNELS]
    even = torch.from_numpy(gaussian_filter1d(route.numpy(), SMOOTH_FRAMES, axis=1, mode="nearest"))
    return orthonormalized(torch.cat([route[:, :1], even[:, 1:-1], route[:, -1:]], dim=1))


def fit_pose(
    net: PoseNet,
    routes: Float[Tensor, "clip frame 9"],
    clips: Clips,
    trainer: NetworkTrainer,
    optimizer_config: LongTermOptimizerConfig,
    name: str = "pose",
) -> FitRecord:
    """Fit a PoseNet along routes that are held (Eq. 4)."""
    w, lever = trainer.weights, objectives.lever_of(trainer.poses)

    def loss(index: Tensor) -> dict[str, Tensor]:
        truth = clips.channels[index]
        made = net(
            truth[:, 0, ROOT_CHANNELS:], truth[:, -1, ROOT_CHANNELS:], routes[index], clips.seen.points[index]
        )
        pose = objectives.pose_error(made[..., ROOT_CHANNELS:], truth[..., ROOT_CHANNELS:], lever)
        terms = {"pose": w.pose * pose}
        if net.predicts_rotation:
            terms["rotation"] = w.rotation * objectives.route_error(made, truth)[1]
        return terms

    return trainer.fitted(name, net, optimizer_config, loss, len(clips))


def fit_base(
    net: BaseNet,
    clips: Clips,
    trainer: NetworkTrainer,
    optimizer_config: LongTermOptimizerConfig,
    name: str = "base",
) -> FitRecord:
    """Fit a BaseNet, its draft alike."""
    w, lever = trainer.weights, objectives.lever_of(trainer.poses)

    def loss(index: Tensor) -> dict[str, Tensor]:
        truth = clips.channels[index]
        made = net.stages(truth[:, 0], truth[:, -1], clips.seen[index])
        shift, turn = _summed_route_errors(made, truth)
        errors = [
            objectives.pose_error(each[..., ROOT_CHANNELS:], truth[..., ROOT_CHANNELS:], lever)
            for each in made
        ]
        pose = sum(errors, start=torch.zeros(()))
        return {"translation": w.translation * shift, "rotation": w.rotation * turn, "pose": w.pose * pose}

    return trainer.fitted(name, net, optimizer_config, loss, len(clips))


def fit_body(
    net: StaticBody,
    bodies: StaticBodies,
    dataset: MotionDataset,
    contacts: ContactVertices,
    trainer: NetworkTrainer,
    optimizer_config: LongTermOptimizerConfig,
) -> FitRecord:
    """Fit the CVAE: reconstruction, KL divergence, contact and collision (Sec. 3.2)."""
    w, poses, lever = trainer.weights, trainer.poses, objectives.lever_of(trainer.poses)
    chosen = dataset.body.sample_vertices(BODY_VERTICES)
    surface = PosedSurface(dataset.body, np.concatenate([chosen, contacts.vertices]))
    frames = torch.from_numpy(bodies.places.world_from_place).float()
    scene, distances = torch.from_numpy(bodies.scene), [each.distance for each in dataset.scenes]
    shape = torch.from_numpy(dataset.body.shape).float()[None]

    def loss(index: Tensor) -> dict[str, Tensor]:
        truth = bodies.truth[index]
        given = net.encode_condition(
            bodies.places.place[index], shape.expand(len(index), -1), bodies.places.points[index]
        )
        mean, log_variance = net.encode(truth, given)
        made = net.decode(mean + torch.randn_like(mean) * (log_variance / 2).exp(), given)
        mesh = objectives.posed(made, frames[index], poses, surface)
        with torch.no_grad():
            true_mesh = objectives.posed(truth, frames[index], poses, surface)
        shift, turn = objectives.route_error(made, truth)
        pose = objectives.pose_error(made[..., ROOT_CHANNELS:], truth[..., ROOT_CHANNELS:], lever)
        collision, contact = objectives.scene_errors(mesh, scene[index], distances, contacts, len(chosen))
        return {
            "root": w.translation * shift + w.rotation * turn,
            "pose": w.pose * pose,
            "vertices": w.vertices * (mesh - true_mesh).norm(dim=-1).mean(),
            "divergence": w.divergence * objectives.kl_divergence(mean, log_variance),
            "collision": w.collision * collision,
            "contact": w.contact * contact,
        }

    return trainer.fitted("body", net, optimizer_config, loss, len(bodies.scene))
