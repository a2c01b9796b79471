"""The losses of long-term motion: L1 on routes and poses (Eqs. 3, 4), contact of static bodies."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.geometry import rigid_torch
from pipeline.geometry.signed_distance import SignedDistance
from pipeline.longterm.bodies import LEVER_M, PosedSurface, PoseSpace
from pipeline.longterm.motion_optimization import collision_error, contact_error
from pipeline.longterm.networks import ROOT_CHANNELS

TOUCHING_M = 0.02
"""scale of the contact loss"""


def route_error(
    made: Float[Tensor, "*batch channel"], truth: Float[Tensor, "*batch known"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return the mean L1 distance of t (meters) and of r (6D rotations, no unit), the first nine channels."""
    parts = (slice(0, 3), slice(3, ROOT_CHANNELS))
    shift, turn = ((made[..., part] - truth[..., part]).abs().mean() for part in parts)
    return shift, turn


def pose_error(
    made: Float[Tensor, "*batch pose"],
    truth: Float[Tensor, "*batch pose"],
    basis_m: Float[Tensor, "pose channel"],
) -> Float[Tensor, ""]:
    """Return the mean L1 distance of the bones' channels decoded from p, meters (radians times 0.1 m)."""
    return ((made - truth) @ basis_m).abs().mean()


def metric_basis(poses: PoseSpace) -> Float[Tensor, "pose channel"]:
    """Return the pose space's basis with all channels in meters."""
    return poses.basis * torch.tensor([LEVER_M] * 3 + [1.0] * 3).repeat(len(poses.rest))


def kl_divergence(
    mean: Float[Tensor, "batch latent"], log_variance: Float[Tensor, "batch latent"]
) -> Float[Tensor, ""]:
    """Return the mean KL divergence from the standard normal distribution, per dimension of z."""
    return 0.5 * (mean**2 + log_variance.exp() - 1 - log_variance).mean()


def posed_vertices(
    body: Float[Tensor, "batch channel"],
    world_from_place: Float[Tensor, "batch 4 4"],
    poses: PoseSpace,
    surface: PosedSurface,
) -> Float[Tensor, "batch vertex 3"]:
    """Return the world vertices of bodies given by their channels."""
    place_from_agent = rigid_torch.make(rigid_torch.rotation_from_6d(body[:, 3:ROOT_CHANNELS]), body[:, :3])
    return surface(world_from_place @ place_from_agent, poses.bones(poses.decode(body[:, ROOT_CHANNELS:])))


def scene_errors(
    vertices: Float[Tensor, "batch vertex 3"],
    scene: Int[Tensor, "batch"],
    scenes: list[SignedDistance],
    count: int,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return mean collision error (meters) and contact error of bodies; ``scene`` is the scene index of each.

    Vertices are in the world; those from ``count`` on are the contact vertices.
    """
    distance = torch.zeros(vertices.shape[:2])
    for index, each in enumerate(scenes):
        rows = torch.nonzero(scene == index)[:, 0]
        if len(rows):
            distance = distance.index_put((rows,), each.at(vertices[rows]))
    return collision_error(distance, 0.0).mean(), contact_error(distance[:, count:], TOUCHING_M).mean()
