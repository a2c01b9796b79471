"""Physical plausibility of motion in a scene: collision, contact, foot skate and seams, as in the paper.

`plausibility` takes the stance as an argument, so that a motion can be measured with the same stance before
and after optimization.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float

from pipeline.geometry.signed_distance import SignedDistance
from pipeline.longterm.bodies import PosedSurface, SkinnedBody
from pipeline.longterm.contacts import ContactVertices, detect_stance
from pipeline.longterm.short_motions import RATE_HZ, BodyMotion

FRAMES_AT_ONCE = 200
"""Frames per batch, to bound memory."""
SOLID_M = 0.005
"""A vertex penetrating the scene by more than this collides; grid and fur are no more accurate."""
CONTACT_M = 0.02
"""A body with a contact vertex within this distance of the scene is in contact."""


@dataclass(frozen=True)
class Plausibility:
    """Metrics of one motion."""

    non_collision: float
    """share of vertices without collision, over all frames"""
    contact: float
    """share of frames with contact"""
    penetration_m: float
    """mean penetration depth over vertices and frames"""
    deepest_m: float
    """largest penetration depth of any vertex and frame"""
    slide_m_s: float
    """foot skate: median horizontal speed of feet in stance; NaN without any stance"""
    min_slide_m_s: float
    """median horizontal speed of the slowest foot near the scene, which should be in stance"""


@dataclass(frozen=True)
class PlausibilityMeter:
    """Measures motions of a body, with its contact vertices, in a scene."""

    body: SkinnedBody
    contacts: ContactVertices
    scene: SignedDistance

    @cached_property
    def surface(self) -> PosedSurface:
        """The full surface of the body."""
        return PosedSurface(self.body)

    def stance(self, motion: BodyMotion, *, should_stand: bool = False) -> Bool[np.ndarray, "frame foot"]:
        """Return the stance of each foot, or with ``should_stand`` which feet should be in stance."""
        points = PosedSurface(self.body, self.contacts.vertices)(*motion.tensors())
        centers, height = self.contacts.centers(points), self.contacts.lowest(self.scene.at(points))
        roots = motion.world_from_agent[:, :3, 3]
        return detect_stance(centers.numpy(), height.numpy(), roots, should_stand=should_stand)

    def gap_and_penetration(
        self, motion: BodyMotion
    ) -> tuple[Float[np.ndarray, "frame"], Float[np.ndarray, "frame"]]:
        """Return per frame the gap between contact vertices and scene, and the penetration depth, meters."""
        distance = self.scene.at(self.surface(*motion.tensors()))
        gap = distance[:, self.contacts.vertices].min(1).values.clamp_min(0)
        return gap.numpy(), (-distance).clamp_min(0).amax(1).numpy()

    def plausibility(self, motion: BodyMotion, stance: Bool[np.ndarray, "frame foot"]) -> Plausibility:
        """Measure a motion on all vertices of the body."""
        distances, points = [], []
        for start in range(0, len(motion), FRAMES_AT_ONCE):
            vertices = self.surface(*motion[start : start + FRAMES_AT_ONCE].tensors())
            distances.append(self.scene.at(vertices))
            points.append(vertices[:, self.contacts.vertices])
        distance = torch.cat(distances)
        centers = self.contacts.centers(torch.cat(points)).numpy()
        both = stance[1:] & stance[:-1]
        speed = np.linalg.norm(np.diff(centers, axis=0)[..., [0, 2]], axis=-1) * RATE_HZ
        near = self.contacts.lowest(distance[1:, self.contacts.vertices]).numpy() < CONTACT_M
        slowest = np.where(near, speed, np.inf).min(axis=1, initial=np.inf)
        skate, slowest = speed[both], slowest[np.isfinite(slowest)]
        return Plausibility(
            non_collision=float((distance > -SOLID_M).float().mean()),
            contact=float((distance[:, self.contacts.vertices].min(1).values < CONTACT_M).float().mean()),
            penetration_m=float((-distance).clamp_min(0).mean()),
            deepest_m=float((-distance).clamp_min(0).max()),
            slide_m_s=float(np.median(skate)) if len(skate) else float("nan"),
            min_slide_m_s=float(np.median(slowest)) if len(slowest) else float("nan"),
        )


def seams(
    body: SkinnedBody, motion: BodyMotion, every: int, vertices: int | None = 200
) -> Float[np.ndarray, "seam vertex"]:
    """Return how much longer each vertex's step is at every ``every``-th frame than beside it, meters.

    ``vertices`` is the number of sampled vertices; None: all.
    """
    surface = PosedSurface(body, None if vertices is None else body.sample_vertices(vertices))
    at = np.arange(every, len(motion) - 2, every)
    around = motion[(at[:, None] + np.arange(-2, 3)).reshape(-1)]
    points = surface(*around.tensors()).unflatten(0, (len(at), 5))
    step = (points[:, 1:] - points[:, :-1]).norm(dim=-1).numpy()
    return (step[:, 1:3].max(1) - np.maximum(step[:, 0], step[:, 3])).clip(0)
