"""Fit the networks of long-term motion in turn: static bodies, routes, then poses along fixed routes."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from pipeline.core import distributed
from pipeline.core.training import FitRecord, fit
from pipeline.longterm.bodies import PosedSurface, PoseSpace
from pipeline.longterm.clip_channels import Clips
from pipeline.longterm.config import LongTermOptimizerConfig
from pipeline.longterm.contacts import ContactVertices
from pipeline.longterm.examples import MotionDataset, StaticBodies
from pipeline.longterm.networks import ROOT_CHANNELS, BaseNet, PoseNet, RouteNet, StaticBody
from stages.train_longterm import objectives

GRADIENT_NORM = 1.0
"""Maximum gradient norm."""
SAVE_EVERY = 200
"""Steps between checkpoints: at most about a minute of training."""
CHUNK = 256
"""Batch size of inference."""
BODY_VERTICES = 150
"""Surface vertices sampled for the CVAE's losses."""
MIN_RATE = 1e-3
"""Share of the peak learning rate at both ends."""
WARMUP = 0.03
"""Share of the training with linear warm-up."""


@dataclass(frozen=True)
class LongTermLossWeights:
    """Weights of the loss terms."""

    translation: float = 1.0
    """lambda_t, per meter"""
    rotation: float = 1.0
    """lambda_r"""
    pose: float = 10.0
    """lambda_p, per meter of the bones"""
    divergence: float = 0.003
    """KL term of the CVAE"""
    vertices: float = 5.0
    """distance of the CVAE's mesh from the true one, per meter"""
    collision: float = 5.0
    """CVAE: penetration depth, per meter"""
    contact: float = 0.02
    """CVAE: robust distance of contact vertices from the scene"""


def cosine(progress: float) -> float:
    """Return the learning rate factor: linear warm-up times cosine decay, plus `MIN_RATE`."""
    warm = min(1.0, (progress + MIN_RATE) / WARMUP)
    return warm * 0.5 * (1 + np.cos(np.pi * min(progress, 1.0))) + MIN_RATE


@dataclass(frozen=True)
class NetworkTrainer:
    """Settings shared by the training of all networks."""

    poses: PoseSpace
    weights: LongTermLossWeights
    seed: int
    resume: Path | None = None

    def train(
        self,
        name: str,
        net: nn.Module,
        optimizer_config: LongTermOptimizerConfig,
        loss: Callable[[Int[Tensor, "batch"]], dict[str, Float[Tensor, ""]]],
        examples: int,
    ) -> FitRecord:
        """Fit one network in place on random batches, split among processes."""
        optimizer = torch.optim.Adam(net.parameters(), lr=optimizer_config.rate)

        def step_loss(step: int, generator: torch.Generator) -> dict[str, Tensor]:
            batch = distributed.share(optimizer_config.batch)
            return loss(torch.randint(examples, (batch,), generator=generator))

        folder = self.resume / name if self.resume else None
        record = fit(
            modules={"net": net},
            optimizer=optimizer,
            loss=step_loss,
            steps=max(1, round(optimizer_config.epochs * examples / optimizer_config.batch)),
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


def fit_stages(
    net: RouteNet | BaseNet,
    clips: Clips,
    trainer: NetworkTrainer,
    optimizer_config: LongTermOptimizerConfig,
    name: str = "route",
) -> FitRecord:
    """Fit a RouteNet (Eq. 3), or a BaseNet, which predicts poses too; all its stages have the same loss."""
    w, basis_m = trainer.weights, objectives.metric_basis(trainer.poses)

    def loss(index: Tensor) -> dict[str, Tensor]:
        truth = clips.channels[index]
        made = net.stages(truth[:, 0], truth[:, -1], clips.seen[index])
        errors = zip(*(objectives.route_error(each, truth) for each in made), strict=True)
        shift, turn = (sum(parts, start=torch.zeros(())) for parts in errors)
        terms = {"translation": w.translation * shift}
        if isinstance(net, BaseNet) or net.predicts_rotation:
            terms["rotation"] = w.rotation * turn
        if isinstance(net, BaseNet):
            bodies = (each[..., ROOT_CHANNELS:] for each in made)
            errors = [objectives.pose_error(each, truth[..., ROOT_CHANNELS:], basis_m) for each in bodies]
            terms["pose"] = w.pose * sum(errors, start=torch.zeros(()))
        return terms

    return trainer.train(name, net, optimizer_config, loss, len(clips))


def predicted_routes(net: RouteNet, clips: Clips) -> Float[Tensor, "clip frame 9"]:
    """Return the routes that a RouteNet predicts for clips."""
    with torch.no_grad():
        ends, batches = clips.channels[:, [0, -1]], torch.arange(len(clips)).split(CHUNK)
        return torch.cat([net(ends[rows, 0], ends[rows, 1], clips.seen[rows]) for rows in batches])


def fit_pose(
    net: PoseNet,
    routes: Float[Tensor, "clip frame 9"],
    clips: Clips,
    trainer: NetworkTrainer,
    optimizer_config: LongTermOptimizerConfig,
    name: str = "pose",
) -> FitRecord:
    """Fit a PoseNet along fixed routes (Eq. 4)."""
    w, basis_m = trainer.weights, objectives.metric_basis(trainer.poses)

    def loss(index: Tensor) -> dict[str, Tensor]:
        truth = clips.channels[index]
        made = net(
            truth[:, 0, ROOT_CHANNELS:], truth[:, -1, ROOT_CHANNELS:], routes[index], clips.seen.points[index]
        )
        pose = objectives.pose_error(made[..., ROOT_CHANNELS:], truth[..., ROOT_CHANNELS:], basis_m)
        terms = {"pose": w.pose * pose}
        if net.predicts_rotation:
            terms["rotation"] = w.rotation * objectives.route_error(made, truth)[1]
        return terms

    return trainer.train(name, net, optimizer_config, loss, len(clips))


def fit_body(
    net: StaticBody,
    bodies: StaticBodies,
    dataset: MotionDataset,
    contacts: ContactVertices,
    trainer: NetworkTrainer,
    optimizer_config: LongTermOptimizerConfig,
) -> FitRecord:
    """Fit the CVAE: reconstruction, KL divergence, contact and collision (Sec. 3.2)."""
    w, poses, basis_m = trainer.weights, trainer.poses, objectives.metric_basis(trainer.poses)
    chosen = dataset.body.sample_vertices(BODY_VERTICES)
    surface = PosedSurface(dataset.body, np.concatenate([chosen, contacts.vertices]))
    frames = torch.from_numpy(bodies.places.world_from_place).float()
    scene, distances = torch.from_numpy(bodies.scene), [each.distance for each in dataset.scenes]
    shape = torch.from_numpy(dataset.body.shape).float()[None]

    def loss(index: Tensor) -> dict[str, Tensor]:
        truth = bodies.truth[index]
        condition = net.encode_condition(
            bodies.places.place[index], shape.expand(len(index), -1), bodies.places.points[index]
        )
        mean, log_variance = net.encode(truth, condition)
        made = net.decode(mean + torch.randn_like(mean) * (log_variance / 2).exp(), condition)
        mesh = objectives.posed_vertices(made, frames[index], poses, surface)
        with torch.no_grad():
            true_mesh = objectives.posed_vertices(truth, frames[index], poses, surface)
        shift, turn = objectives.route_error(made, truth)
        pose = objectives.pose_error(made[..., ROOT_CHANNELS:], truth[..., ROOT_CHANNELS:], basis_m)
        collision, contact = objectives.scene_errors(mesh, scene[index], distances, len(chosen))
        return {
            "root": w.translation * shift + w.rotation * turn,
            "pose": w.pose * pose,
            "vertices": w.vertices * (mesh - true_mesh).norm(dim=-1).mean(),
            "divergence": w.divergence * objectives.kl_divergence(mean, log_variance),
            "collision": w.collision * collision,
            "contact": w.contact * contact,
        }

    return trainer.train("body", net, optimizer_config, loss, len(bodies.scene))
