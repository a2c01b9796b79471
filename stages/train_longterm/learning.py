"""Train a model from motion: contact vertices, pose space, then all networks in order."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from safetensors.torch import load_file
from torch import nn

from pipeline.baselines import longterm_networks
from pipeline.baselines.longterm_networks import AblatedNetworks
from pipeline.core.errors import InputError
from pipeline.core.training import FitRecord
from pipeline.longterm import examples
from pipeline.longterm.clip_channels import Clips
from pipeline.longterm.config import LongTermSizes
from pipeline.longterm.contacts import find_contact_vertices
from pipeline.longterm.motion_synthesis import LongTerm, measure_motion_prior
from pipeline.longterm.networks import PointNet, PoseNet, RouteNet, StaticBody
from stages.train_longterm import training
from stages.train_longterm.config import Config
from stages.train_longterm.training import LongTermLossWeights, NetworkTrainer

Network = TypeVar("Network", bound=nn.Module)
DEFAULT_SIZES = LongTermSizes()
"""Sizes of every build; tests use smaller ones."""


@dataclass(frozen=True)
class TrainedLongTerm:
    """A trained model, its training records, and the ablated networks that the tables compare with."""

    model: LongTerm
    records: dict[str, FitRecord]
    ablated: dict[str, AblatedNetworks] = field(default_factory=dict)


def train_networks(
    dataset: examples.MotionDataset,
    config: Config,
    *,
    sizes: LongTermSizes = DEFAULT_SIZES,
    resume: Path | None = None,
) -> TrainedLongTerm:
    """Train StaticBody, RouteNet, PoseNet and the ablations that ``config`` names."""
    rng = np.random.default_rng(config.seed)
    sizes = replace(sizes, shape=len(dataset.body.shape))
    poses = examples.fit_pose_space(dataset.stretches, dataset.body.agent_from_bone_rest, sizes.pose)
    contacts = find_contact_vertices(dataset.body, list(dataset.stretches), dataset.distances)
    chosen = examples.select_clips(dataset, rng, stride=config.clip_stride)
    clips = examples.encode_selection(dataset, chosen, poses, sizes.points, rng)
    stills = examples.sample_static_bodies(dataset, poses, sizes.points, rng, most=config.max_bodies)
    trainer = NetworkTrainer(poses, LongTermLossWeights(), config.seed, resume)
    static = initialized(lambda: StaticBody(sizes), config)
    route = initialized(lambda: RouteNet(sizes, with_scene=config.scene), config)
    pose = initialized(lambda: PoseNet(sizes, with_scene=config.scene), config)
    records = {
        "static": training.fit_body(static, stills, dataset, contacts, trainer, config.body),
        "route": training.fit_stages(route, clips, trainer, config.route),
    }
    along = training.predicted_routes(route, clips)
    records["pose"] = training.fit_pose(pose, along, clips, trainer, config.pose)
    prior = measure_motion_prior(list(dataset.stretches), [dataset.scenes[each] for each in dataset.scene_of])
    model = LongTerm(sizes, poses, contacts, prior, static, route, pose)
    return TrainedLongTerm(model, records, train_ablations(clips, trainer, config, sizes, route))


def train_ablations(
    clips: Clips, trainer: NetworkTrainer, config: Config, sizes: LongTermSizes, route: RouteNet
) -> dict[str, AblatedNetworks]:
    """Train the ablations of Table 1 that ``config`` names; those with the same RouteNet share it."""
    routes, trained = {(config.scene, True, False): route}, {}
    names = {"none": (), "baselines": longterm_networks.BASELINES, "all": tuple(longterm_networks.ABLATIONS)}
    for name in names[config.ablations]:
        spec = longterm_networks.ABLATIONS[name]
        made = initialized(lambda spec=spec: longterm_networks.build(spec, sizes), config)
        if made.base is not None:
            training.fit_stages(made.base, clips, trainer, config.pose, name)
        elif made.route is not None and made.pose is not None:
            key = (spec.with_scene, spec.route_turns, spec.paper)
            if key not in routes:
                training.fit_stages(made.route, clips, trainer, config.route, f"{name}_route")
                routes[key] = made.route
            made.route.load_state_dict(routes[key].state_dict())
            along = training.predicted_routes(made.route, clips)
            training.fit_pose(made.pose, along, clips, trainer, config.pose, f"{name}_pose")
        trained[name] = made.eval()
    return trained


def write_ablations(folder: Path, learned: TrainedLongTerm) -> None:
    """Write `ablations/<name>.safetensors`, if there are any."""
    if learned.ablated:
        (folder / "ablations").mkdir()
        for name, made in learned.ablated.items():
            made.save(folder / "ablations" / f"{name}.safetensors")


def initialized(make: Callable[[], Network], config: Config) -> Network:
    """Build a network from the seed, with pretrained PointNet weights if ``config`` names them."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        net = make()
    path = config.point_net
    if path is None:
        return net
    if not Path(path).is_file():
        remedy = "give an existing safetensors file, or none"
        raise InputError("LTM-002", "the weights of PointNet are not there", path, remedy)
    try:
        for part in net.modules():
            if isinstance(part, PointNet) and part.with_scene:
                part.load_state_dict(load_file(path))
    except (RuntimeError, ValueError) as error:
        what, remedy = f"these weights do not fit: {error}", "they must have the widths of `sizes`"
        raise InputError("LTM-002", what, path, remedy) from error
    return net
