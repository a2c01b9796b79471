"""What frames say against the agent's having been somewhere: the phone looked through that place, or its holder stood there."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.space import cameras, rigid_torch
from stages.reconstruct.rays import THUMBNAIL, Views

HEADINGS = 4
THROUGH_M = 0.05
"""depth this far behind a point looks through it"""
DOUBT = 0.1
"""share of a body that may be looked through all the same: its shape and its posture are guessed"""
SURE = 8.0
"""nats that speak against a body that is looked through all over, per `SECOND_LOOK_S`"""
SECOND_LOOK_S = 0.3
"""looks sooner after each other say the same"""


@dataclass(frozen=True)
class Stand:
    """Points of the agent at rest, about its root, in several headings."""

    points: Float[Tensor, "heading point 3"]

    @classmethod
    def of(cls, points: Float[Tensor, "point 3"], most: int = 16) -> "Stand":
        """Turn some of the points about the vertical."""
        points = points[torch.linspace(0, len(points) - 1, min(most, len(points))).long()]
        angle = torch.arange(HEADINGS) * (2 * torch.pi / HEADINGS)
        upright = rigid_torch.so3_exp(angle[:, None] * torch.tensor([0.0, 1.0, 0.0]))
        return cls((upright[:, None] @ points[..., None].cpu())[..., 0])


@torch.no_grad()
def looked_through(
    views: Views, frame: int, camera_from_world: Float[Tensor, "4 4"], body: Stand, place: Float[Tensor, "cell 3"]
) -> Float[Tensor, "cell heading"]:
    """Return which share of a body that stood in each cell one frame looked through."""
    points = rigid_torch.apply(camera_from_world, (place[:, None, None] + body.points).view(-1, 3))
    pixel, depth = cameras.project(points, views.intrinsics[frame].cpu())
    cell = (pixel / THUMBNAIL).floor().long()
    picture = views.depth[frame].cpu()
    height, width = picture.shape
    inside = (depth > 0.1) & (cell >= 0).all(-1) & (cell[:, 0] < width) & (cell[:, 1] < height)
    measured = picture[cell[:, 1].clamp(0, height - 1), cell[:, 0].clamp(0, width - 1)].float()
    through = inside & (measured > depth + THROUGH_M)
    return through.view(len(place), *body.points.shape[:2]).float().mean(-1)


def evidence(
    views: Views,
    frames: Int[np.ndarray, "frame"],
    camera_from_world: Float[Tensor, "frame 4 4"],
    duration_s: Float[np.ndarray, "frame"],
    body: Stand,
    place: Float[np.ndarray, "cell 3"],
    near_m: float = 0.0,
) -> Float[np.ndarray, "frame cell"]:
    """Return the logarithm of each frame's likelihood of the agent in each cell, which the masks of these frames do not show.

    Cells nearer to the phone than ``near_m``, along the ground, count as looked through: nobody lets the animal so near.
    """
    points, found = torch.from_numpy(place).float(), np.zeros((len(frames), len(place)))
    for row, (frame, camera) in enumerate(zip(frames.tolist(), camera_from_world.cpu(), strict=True)):
        if camera.isfinite().all():
            share = looked_through(views, frame, camera, body, points)
            eye = rigid_torch.inverse(camera)[:3, 3]
            share[(points - eye)[:, [0, 2]].norm(dim=-1) < near_m] = 1
            against = -SURE * (share - DOUBT).clamp_min(0)
            found[row] = (against.logsumexp(-1) - np.log(HEADINGS)).numpy() * min(1.0, duration_s[row] / SECOND_LOOK_S)
    return found
