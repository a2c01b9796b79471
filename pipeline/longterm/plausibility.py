"""How physical a motion in a scene is: collision, contact, sliding feet and seams, as the paper counts them.

`stance` says which feet stand when; `plausibility` measures a motion with it, so that a motion before and
after it was optimised is judged by the same stance.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float

from pipeline.geometry.signed_distance import SignedDistance
from pipeline.longterm.bodies import PosedSurface, SkinnedBody
from pipeline.longterm.contacts import ContactVertices, detect_stance, motion_tensors
from pipeline.longterm.short_motions import RATE_HZ, BodyMotion

FRAMES_AT_ONCE = 200
"""Frames whose vertices are held at a time, for memory."""
SOLID_M = 0.005
"""A vertex deeper than this inside the scene collides: half a centimetre is what grid and fur leave open."""
CONTACT_M = 0.02
"""A body whose closest contact vertex is no further than this from the scene touches it."""


@dataclass(frozen=True)
class Plausibility:
    """Figures of one motion."""

    non_collision: float
    """share of vertices and frames outside of what is solid"""
    contact: float
    """share of frames in which the body touches the scene"""
    penetration_m: float
    """mean depth inside the scene over vertices and frames"""
    deepest_m: float
    """deepest vertex of any frame, a positive number"""
    slide_m_s: float
    """median speed along the ground of feet while they stand, or should; NaN where none does"""
    min_slide_m_s: float
    """median speed over the ground of the slowest foot near the scene: one should stand"""


@dataclass(frozen=True)
class PlausibilityMeter:
    """A body and its contacts in a scene, ready to measure motions."""

    body: SkinnedBody
    contacts: ContactVertices
    scene: SignedDistance

    @cached_property
    def surface(self) -> PosedSurface:
        """All vertices of the body, to be posed."""
        return PosedSurface(self.body)

    def stance(self, motion: BodyMotion, *, should_stand: bool = False) -> Bool[np.ndarray, "frame foot"]:
        """Return which feet stand when, or with ``should_stand`` which should."""
        points = PosedSurface(self.body, self.contacts.vertices)(*motion_tensors(motion))
        centres, height = self.contacts.centres(points), self.contacts.lowest(self.scene.at(points))
        roots = motion.world_from_agent[:, :3, 3]
        return detect_stance(centres.numpy(), height.numpy(), roots, should_stand=should_stand)

    def gap_and_penetration(
        self, motion: BodyMotion
    ) -> tuple[Float[np.ndarray, "frame"], Float[np.ndarray, "frame"]]:
        """Return, per frame, the gap between body and scene and the depth of the deepest vertex, metres."""
        distance = self.scene.at(self.surface(*motion_tensors(motion)))
        gap = distance[:, self.contacts.vertices].min(1).values.clamp_min(0)
        return gap.numpy(), (-distance).clamp_min(0).amax(1).numpy()

    def plausibility(self, motion: BodyMotion, stance: Bool[np.ndarray, "frame foot"]) -> Plausibility:
        """Measure a motion on all vertices of the body."""
        distance, points = [], []
        for start in range(0, len(motion), FRAMES_AT_ONCE):
            vertices = self.surface(*motion_tensors(motion[start : start + FRAMES_AT_ONCE]))
            distance.append(self.scene.at(vertices))
            points.append(vertices[:, self.contacts.vertices])
        depth, touching = torch.cat(distance), torch.cat(points)
        centres = self.contacts.centres(touching).numpy()
        both = stance[1:] & stance[:-1]
        speed = np.linalg.norm(np.diff(centres, axis=0)[..., [0, 2]], axis=-1) * RATE_HZ
        near = self.contacts.lowest(depth[1:, self.contacts.vertices]).numpy() < CONTACT_M
        least = np.where(near, speed, np.inf).min(axis=1, initial=np.inf)
        slide, least = speed[both], least[np.isfinite(least)]
        return Plausibility(
            non_collision=float((depth > -SOLID_M).float().mean()),
            contact=float((depth[:, self.contacts.vertices].min(1).values < CONTACT_M).float().mean()),
            penetration_m=float((-depth).clamp_min(0).mean()),
            deepest_m=float((-depth).clamp_min(0).max()),
            slide_m_s=float(np.median(slide)) if len(slide) else float("nan"),
            min_slide_m_s=float(np.median(least)) if len(least) else float("nan"),
        )


def seams(
    body: SkinnedBody, motion: BodyMotion, every: int, vertices: int | None = 200
) -> Float[np.ndarray, "seam vertex"]:
    """Return, at every ``every``-th frame, how much further each vertex moves than in the frames beside it,
    metres.

    ``vertices`` spread over the surface are looked at; None: all.
    """
    surface = PosedSurface(body, None if vertices is None else body.sample_vertices(vertices))
    at = np.arange(every, len(motion) - 2, every)
    around = motion[(at[:, None] + np.arange(-2, 3)).reshape(-1)]
    points = surface(*motion_tensors(around)).unflatten(0, (len(at), 5))
    step = (points[:, 1:] - points[:, :-1]).norm(dim=-1).numpy()
    return (step[:, 1:3].max(1) - np.maximum(step[:, 0], step[:, 3])).clip(0)
