"""The networks that long-term motion is compared with (Table 1 of the paper), all with one face: `Ablated.between`.

`KINDS` names them; `build` makes one, `Ablated.load` reads one back.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from pipeline.models.longterm import ROOT, BaseNet, PoseNet, RouteNet, Sizes
from pipeline.models.wayside import Seen


@dataclass(frozen=True)
class Kind:
    """What one of them may do."""

    seeing: bool = True
    """see the scene"""
    route_turns: bool = True
    """RouteNet predicts orientations; else PoseNet does"""
    paper: bool = False
    """RouteNet makes no draft and sees positions, orientations and scene points only; PoseNet has no `Strides` and learns along such routes"""
    follows: bool = True
    """PoseNet is given the route"""
    one: bool = False
    """BaseNet: one network for everything"""


KINDS: dict[str, Kind] = {
    "ours_no_scene": Kind(seeing=False),
    "as_paper": Kind(paper=True),
    "route_t_pose": Kind(route_turns=False, follows=False),
    "route_t_pose_no_scene": Kind(seeing=False, route_turns=False, follows=False),
    "route_tr_pose": Kind(follows=False),
    "route_tr_pose_no_scene": Kind(seeing=False, follows=False),
    "base": Kind(one=True),
    "base_no_scene": Kind(seeing=False, one=True),
}

RIVALS = ("ours_no_scene", "base")
"""Those that say whether the scene, and two networks instead of one, are worth it."""


class Ablated(nn.Module):
    """Short motions by other networks."""

    def __init__(self, route: RouteNet | None, pose: PoseNet | None, base: BaseNet | None):
        super().__init__()
        self.route, self.pose, self.base = route, pose, base

    def between(
        self, start: Float[Tensor, "clip channel"], end: Float[Tensor, "clip channel"], seen: Seen
    ) -> Float[Tensor, "clip frame channel"]:
        """Return t, r, p between first and last frames, in the clips' frames."""
        with torch.no_grad():
            if self.base is not None:
                return self.base(start, end, seen)
            route = self.route(start, end, seen)
            return self.pose(start[:, ROOT:], end[:, ROOT:], route, seen.points)

    def save(self, path: Path) -> None:
        """Write the weights."""
        save_file({name: value.contiguous() for name, value in self.state_dict().items()}, path)


def build(kind: Kind, sizes: Sizes) -> Ablated:
    """Make untrained networks."""
    if kind.one:
        return Ablated(None, None, BaseNet(sizes, seeing=kind.seeing))
    route = RouteNet(sizes, seeing=kind.seeing, turns=kind.route_turns, blind=kind.paper)
    pose = PoseNet(sizes, seeing=kind.seeing, follows=kind.follows, turns=not kind.route_turns, strides=not kind.paper)
    return Ablated(route, pose, None)


def load(path: Path, kind: Kind, sizes: Sizes) -> Ablated:
    """Read networks that `Ablated.save` wrote."""
    made = build(kind, sizes)
    made.load_state_dict(load_file(path))
    return made.eval()
