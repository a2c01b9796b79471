"""Ablated networks of long-term motion (Table 1 of the paper), with the interface `AblatedNetworks.between`.

`ABLATIONS` lists them; `build` makes one, `load` reads one that `AblatedNetworks.save` wrote.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from pipeline.longterm.config import LongTermSizes
from pipeline.longterm.local_scene import LocalScene
from pipeline.longterm.networks import ROOT_CHANNELS, BaseNet, PoseNet, RouteNet


@dataclass(frozen=True)
class AblationSpec:
    """Options of an ablation."""

    with_scene: bool = True
    """condition on the scene"""
    route_turns: bool = True
    """RouteNet predicts orientations; else PoseNet does"""
    paper: bool = False
    """RouteNet makes no draft and reads positions, orientations and scene points only; PoseNet has no
    `GaitPhase`"""
    follows_route: bool = True
    """PoseNet is conditioned on the route"""
    one: bool = False
    """BaseNet: one network for route and poses"""


ABLATIONS: dict[str, AblationSpec] = {
    "ours_no_scene": AblationSpec(with_scene=False),
    "as_paper": AblationSpec(paper=True),
    "route_t_pose": AblationSpec(route_turns=False, follows_route=False),
    "route_t_pose_no_scene": AblationSpec(with_scene=False, route_turns=False, follows_route=False),
    "route_tr_pose": AblationSpec(follows_route=False),
    "route_tr_pose_no_scene": AblationSpec(with_scene=False, follows_route=False),
    "base": AblationSpec(one=True),
    "base_no_scene": AblationSpec(with_scene=False, one=True),
}

BASELINES = ("ours_no_scene", "base")
"""Ablations of the scene, and of two networks in place of one."""


class AblatedNetworks(nn.Module):
    """Generators of short motions by ablated networks."""

    def __init__(self, route: RouteNet | None, pose: PoseNet | None, base: BaseNet | None):
        super().__init__()
        self.route, self.pose, self.base = route, pose, base

    def between(
        self, start: Float[Tensor, "clip channel"], end: Float[Tensor, "clip channel"], seen: LocalScene
    ) -> Float[Tensor, "clip frame channel"]:
        """Return translation, rotation and pose between first and last frames, in the clips' frames."""
        with torch.no_grad():
            if self.base is not None:
                return self.base(start, end, seen)
            assert self.route is not None and self.pose is not None, "one network or two"
            route = self.route(start, end, seen)
            return self.pose(start[:, ROOT_CHANNELS:], end[:, ROOT_CHANNELS:], route, seen.points)

    def save(self, path: Path) -> None:
        """Write the weights."""
        save_file({name: value.contiguous() for name, value in self.state_dict().items()}, path)


def build(kind: AblationSpec, sizes: LongTermSizes) -> AblatedNetworks:
    """Make untrained networks."""
    if kind.one:
        return AblatedNetworks(None, None, BaseNet(sizes, with_scene=kind.with_scene))
    route = RouteNet(sizes, with_scene=kind.with_scene, predicts_rotation=kind.route_turns, blind=kind.paper)
    pose = PoseNet(
        sizes,
        with_scene=kind.with_scene,
        follows_route=kind.follows_route,
        predicts_rotation=not kind.route_turns,
        strides=not kind.paper,
    )
    return AblatedNetworks(route, pose, None)


def load(path: Path, kind: AblationSpec, sizes: LongTermSizes) -> AblatedNetworks:
    """Read networks that `AblatedNetworks.save` wrote."""
    networks = build(kind, sizes)
    networks.load_state_dict(load_file(path))
    return networks.eval()
