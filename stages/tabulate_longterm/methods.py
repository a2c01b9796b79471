"""In-betweening between given bodies by every method that the tables compare."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.baselines.longterm_networks import AblatedNetworks
from pipeline.longterm.clip_channels import Clips, decode_clip, encode_places
from pipeline.longterm.examples import MotionDataset
from pipeline.longterm.motion_synthesis import LongTerm
from pipeline.longterm.networks import ROOT_CHANNELS
from stages.tabulate_longterm.reading import MotionSource

Method = Callable[[Clips], Float[Tensor, "clip frame channel"]]
"""Predicts all frames of clips from their first and last frames and the scene alone."""
OPTIMIZED = ("ours", "base", "as_paper", "route_cvae", "nearest")
"""Methods that are also evaluated after optimization."""
WITHOUT_SCENE = {"ours": "ours_no_scene", "route_t_pose": "route_t_pose_no_scene", "base": "base_no_scene"}
"""Methods that see the scene, and their ablations without it; `route_tr_pose` has the routes of ours."""
COMPARED_WITH = {"base": "ours", "as_paper": "ours", "route_cvae": "ours", "nearest": "ours"} | {
    blind: with_scene for with_scene, blind in WITHOUT_SCENE.items()
}
"""Pairs of methods whose difference in error per clip is reported with intervals."""


def methods(source: MotionSource, dataset: MotionDataset, seed: int) -> dict[str, Method]:
    """Return every method by its name in the tables."""

    def by(net: LongTerm | AblatedNetworks) -> Method:
        return lambda clips: net.between(clips.channels[:, 0], clips.channels[:, -1], clips.seen)

    trained = {"ours": by(source.ours)} | {name: by(net) for name, net in source.ablated.items()}
    return trained | {
        "route_cvae": lambda clips: route_cvae(source.ours, clips, dataset, np.random.default_rng(seed)),
        "nearest": lambda clips: nearest(source.bank, clips),
    }


def route_cvae(
    model: LongTerm, clips: Clips, dataset: MotionDataset, rng: np.random.Generator
) -> Float[Tensor, "clip frame channel"]:
    """Follow RouteNet's route with a CVAE body in every frame, one z per clip (Route + CVAE)."""
    with torch.no_grad():
        route = model.route(clips.channels[:, 0], clips.channels[:, -1], clips.seen)
        made = []
        for index in range(len(clips)):
            channels = torch.cat([route[index], route.new_zeros(route.shape[1], model.sizes.pose)], dim=-1)
            roots = decode_clip(channels, clips.world_from_clip[index], model.poses).world_from_agent
            places = encode_places(
                roots, np.full(len(roots), clips.scene[index]), dataset.scenes, model.sizes.points, rng
            )
            shape = torch.from_numpy(dataset.body.shape).float().expand(len(roots), -1)
            z = torch.from_numpy(rng.standard_normal(model.sizes.latent)).float().expand(len(roots), -1)
            drawn = model.static.decode(z, model.static.encode_condition(places.place, shape, places.points))
            made.append(torch.cat([route[index], drawn[:, ROOT_CHANNELS:]], dim=-1))
    return torch.stack(made)


def nearest(bank: Clips, clips: Clips) -> Float[Tensor, "clip frame channel"]:
    """Return the training clips whose ends are nearest to those of each clip (after HSNMS)."""

    def ends(some: Clips) -> Float[Tensor, "clip channel"]:
        both = some.channels[:, [0, -1]]
        return torch.cat([both[..., :ROOT_CHANNELS], 0.1 * both[..., ROOT_CHANNELS:]], dim=-1).flatten(1)

    return bank.channels[torch.cdist(ends(clips), ends(bank)).argmin(1)]
