"""From motion to a model: what the body touches, its pose space, and all networks in their order."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file
from torch import nn

from pipeline.errors import InputError
from pipeline.fit import FitRecord
from pipeline.models import ablated_motion
from pipeline.models.ablated_motion import Ablated
from pipeline.models.clip_channels import Clips
from pipeline.models.contacts import find_contacts
from pipeline.models.longterm import PointNet, PoseNet, RouteNet, StaticBody
from pipeline.models.longterm_examples import Lives, bodies, cut, encoded, fitted_poses
from pipeline.models.motion_synthesis import LongTerm, habits_of
from stages.train_longterm import training
from stages.train_longterm.training import Trainer


@dataclass(frozen=True)
class Learned:
    """A trained model, how training went, and the networks that the tables compare with."""

    model: LongTerm
    records: dict[str, FitRecord]
    ablated: dict[str, Ablated] = field(default_factory=dict)


def learn(lives: Lives, settings: Any, *, resume: Path | None = None) -> Learned:
    """Train everything on some motion; ``settings`` are the stage's."""
    rng = np.random.default_rng(settings.seed)
    settings = replace(settings, sizes=replace(settings.sizes, shape=len(lives.body.shape)))
    poses = fitted_poses(lives.stretches, lives.body.agent_from_bone_rest, settings.sizes.pose)
    contacts = find_contacts(lives.body, list(lives.stretches), lives.distances)
    clips = encoded(lives, cut(lives, settings.cutting, rng), poses, settings.sizes.points, rng)
    stills = bodies(lives, settings.cutting, poses, settings.sizes.points, rng)
    trainer = Trainer(poses, settings.weights, settings.seed, resume)
    nets = {
        "static": fresh(lambda: StaticBody(settings.sizes), settings),
        "route": fresh(lambda: RouteNet(settings.sizes, seeing=settings.scene), settings),
        "pose": fresh(lambda: PoseNet(settings.sizes, seeing=settings.scene), settings),
    }
    records = {
        "static": training.fit_body(nets["static"], stills, lives, contacts, trainer, settings.body),
        "route": training.fit_route(nets["route"], clips, trainer, settings.route),
        "pose": training.fit_pose(nets["pose"], training.true_routes(clips), clips, trainer, settings.pose),
    }
    scenes = [lives.scenes[index] for index in lives.scene_of]
    model = LongTerm(settings.sizes, poses, contacts, habits_of(list(lives.stretches), scenes), **nets)
    return Learned(model, records, learn_ablations(clips, trainer, settings, nets["route"]))


def learn_ablations(clips: Clips, trainer: Trainer, settings: Any, route: RouteNet) -> dict[str, Ablated]:
    """Train those networks of Table 1 that are asked for and not part of the model; routes of the same kind are shared."""
    routes, trained = {(True, True, False): route} if settings.scene else {}, {}
    wanted = {"none": (), "rivals": ablated_motion.RIVALS, "all": tuple(ablated_motion.KINDS)}[settings.ablations]
    for name, kind in ((name, ablated_motion.KINDS[name]) for name in wanted):
        made = fresh(lambda kind=kind: ablated_motion.build(kind, settings.sizes), settings)
        if made.base is not None:
            training.fit_base(made.base, clips, trainer, settings.pose, name)
        else:
            key = (kind.seeing, kind.route_turns, kind.paper)
            if key not in routes:
                training.fit_route(made.route, clips, trainer, settings.route, f"{name}_route")
                routes[key] = made.route
            made.route.load_state_dict(routes[key].state_dict())
            along = training.made_routes(made.route, clips) if kind.paper else training.true_routes(clips)
            training.fit_pose(made.pose, along, clips, trainer, settings.pose, f"{name}_pose")
        trained[name] = made.eval()
    return trained


def write_ablations(folder: Path, learned: Learned) -> None:
    """Write `ablations/<name>.safetensors` where there are any."""
    if learned.ablated:
        (folder / "ablations").mkdir()
        for name, made in learned.ablated.items():
            made.save(folder / "ablations" / f"{name}.safetensors")


def fresh(make: Any, settings: Any) -> nn.Module:
    """Build a network from the seed, its PointNets from given weights if there are any."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        net = make()
    if settings.point_net is not None:
        for part in net.modules():
            if isinstance(part, PointNet) and part.seeing:
                _start(part, Path(settings.point_net))
    return net


def _start(part: PointNet, path: Path) -> None:
    if not path.is_file():
        raise InputError("LTM-002", "the weights of PointNet are not there", str(path), "give an existing safetensors file, or none")
    try:
        part.load_state_dict(load_file(path))
    except (RuntimeError, ValueError) as error:
        raise InputError("LTM-002", f"these weights do not fit: {error}", str(path), "they must have the widths of `sizes`") from error
