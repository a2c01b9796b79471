"""Contact of a body with the scene, found from data: contact vertices, feet, and stance phases of each foot.

`find_contact_vertices` takes the vertices that are among the closest to the scene in many frames; nothing is
labeled by hand. `detect_stance` finds the frames in which each foot is in stance, for any motion.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from pipeline.geometry.signed_distance import SignedDistance
from pipeline.geometry.subsampling import runs
from pipeline.longterm.bodies import PosedSurface, SkinnedBody
from pipeline.longterm.short_motions import RATE_HZ, BodyMotion

TOUCH_M = 0.01
"""A vertex within this distance of the frame's closest ones is in contact too."""
CONTACT_FRAME_SHARE = 0.15
"""A vertex in contact in this share of the frames is a contact vertex."""
FOOT_M = 0.035
"""Contact vertices closer than this at rest belong to the same foot."""
SWING_M_S2 = 15.0
"""Maximum acceleration of a swinging foot: a step of 10 cm takes 0.2 s."""
STRIDE_M = 0.25
"""A stance phase in which the foot slides further than this is split."""
GROUND_PERCENTILE, GROUND_ERROR_M = 20, 0.02
"""percentile of a foot's heights taken as its ground; error of the reconstructed floor"""
STANCE_SPEED, STANCE_SPEED_M_S = 0.4, 0.08
"""a foot slower than this share of the body's speed, or than this speed, is in stance"""
SLOWEST_FOOT, SLOWEST_FOOT_LIFTED = 0.8, 0.6
"""so is the slowest foot below this share of the body's speed: where feet should stand, and otherwise"""
LIFTED_M = 0.03
"""A foot higher than this above its ground is lifted."""
SHORTEST_PHASE_FRAMES = 3
"""Minimum length of a stance phase."""


@dataclass(frozen=True)
class ContactVertices:
    """The contact vertices of a body, grouped into feet."""

    vertices: Int[np.ndarray, "vertex"]
    """indices into the body's surface"""
    foot: Int[np.ndarray, "vertex"]
    """index of the foot that each contact vertex belongs to"""

    @property
    def feet(self) -> int:
        """Number of feet."""
        return int(self.foot.max()) + 1 if len(self.foot) else 0

    def centers(self, vertices_world: Float[Tensor, "frame vertex 3"]) -> Float[Tensor, "frame foot 3"]:
        """Return the centroid of each foot from the positions of the contact vertices."""
        share = vertices_world.new_zeros(self.feet, len(self.foot))
        share[torch.from_numpy(self.foot), torch.arange(len(self.foot))] = 1
        return (share / share.sum(1, keepdim=True)) @ vertices_world

    def lowest(self, distance_m: Float[Tensor, "frame vertex"]) -> Float[Tensor, "frame foot"]:
        """Return the signed distance of each foot to the scene from those of the contact vertices."""
        of_foot = (distance_m[:, np.flatnonzero(self.foot == foot)] for foot in range(self.feet))
        return torch.stack([distance.min(1).values for distance in of_foot], dim=1)


def find_contact_vertices(
    body: SkinnedBody, motions: list[BodyMotion], scenes: list[SignedDistance], *, max_frames: int = 400
) -> ContactVertices:
    """Find the contact vertices of a body from motions, each in its scene, and group them into feet.

    Vertices within 1 cm of the frame's first percentile of distances are in contact, so that a root slightly
    too high or low does not matter.
    """
    surface = PosedSurface(body)
    every = max(1, sum(map(len, motions)) // max_frames)
    touches, frames = np.zeros(len(body.mesh.vertices)), 0
    for motion, scene in zip(motions, scenes, strict=True):
        part = motion[:: min(every, len(motion))]
        distance = scene.at(surface(*part.tensors())).numpy()
        touches += (distance < np.percentile(distance, 1, axis=1, keepdims=True) + TOUCH_M).sum(0)
        frames += len(part)
    share = touches / max(frames, 1)
    chosen = np.flatnonzero(share > min(CONTACT_FRAME_SHARE, 0.5 * share.max()))
    return ContactVertices(chosen, _feet(np.asarray(body.mesh.vertices)[chosen], body.weights[chosen]))


def _feet(
    points: Float[np.ndarray, "vertex 3"], weights: Float[np.ndarray, "vertex bone"]
) -> Int[np.ndarray, "vertex"]:
    """Cluster near vertices of the same bone, and nearly coincident ones of any; largest cluster first."""
    pairs = KDTree(points).query_pairs(FOOT_M, output_type="ndarray")
    bone, distance = weights.argmax(1), np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    pairs = pairs[(bone[pairs[:, 0]] == bone[pairs[:, 1]]) | (distance < FOOT_M / 3)]
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
    _, label = connected_components(graph, directed=False)
    order = np.argsort(-np.bincount(label), kind="stable")
    return np.argsort(order, kind="stable")[label]


def detect_stance(
    centers_world: Float[np.ndarray, "frame foot 3"],
    height_m: Float[np.ndarray, "frame foot"],
    root_world: Float[np.ndarray, "frame 3"],
    *,
    should_stand: bool = False,
) -> Bool[np.ndarray, "frame foot"]:
    """Return the stance of each foot: near the ground, and nearly still or the slowest foot.

    ``height_m`` is the foot's signed distance to the scene. The paper puts the slower of two feet in stance;
    an animal has more, so any foot clearly slower than the body is in stance too. Phases and gaps under 0.1 s
    are removed. With ``should_stand``, return which feet should stand in motion with foot skate: the slowest
    near the ground, at any speed, as in the paper, and any that is slower than the body.
    """
    foot, body = _speed(centers_world), _speed(root_world[:, None])
    smoothed = ndimage.uniform_filter1d(foot, round(RATE_HZ / 6), axis=0, mode="nearest")
    ground = np.percentile(height_m, GROUND_PERCENTILE, axis=0, keepdims=True)
    low = height_m < ground.clip(-GROUND_ERROR_M, GROUND_ERROR_M) + LIFTED_M
    slowest = np.where(low, smoothed, np.inf)
    slowest = slowest == slowest.min(axis=1, keepdims=True)
    slow = foot < np.maximum(STANCE_SPEED * body, STANCE_SPEED_M_S)
    if should_stand:
        slow |= slowest | (smoothed < SLOWEST_FOOT * body)
    else:
        slow |= slowest & (smoothed < SLOWEST_FOOT_LIFTED * body)
    closed = ndimage.binary_closing(slow & low, np.ones((3, 1)))
    stance = ndimage.binary_opening(np.pad(closed, ((1, 1), (0, 0)), mode="edge"), np.ones((3, 1)))[1:-1]
    return enforce_swing_time(stance, centers_world) if should_stand else stance


def enforce_swing_time(
    stance: Bool[np.ndarray, "frame foot"], centers_world: Float[np.ndarray, "frame foot 3"]
) -> Bool[np.ndarray, "frame foot"]:
    """Split, shorten or drop stance phases so that each foot has time to swing between two of them.

    Phases with more than `STRIDE_M` of skate are split. A swing over d meters takes at least
    sqrt(6 d / `SWING_M_S2`) seconds (a cubic in time, at rest at both ends).
    """
    enforced = np.zeros_like(stance)
    for foot, centers in enumerate(np.moveaxis(centers_world, 1, 0)):
        phases: list[range] = []
        for phase in _split_phases(stance[:, foot], centers):
            while (
                phases
                and (pair := _make_room_to_swing(phases[-1], phase, centers)) is None
                and len(phase) > len(phases[-1])
            ):
                phases.pop()
            if not phases:
                phases.append(phase)
            elif pair is not None:
                phases[-1:] = pair
        enforced[[frame for phase in phases for frame in phase], foot] = True
    return enforced


def _split_phases(
    stance: Bool[np.ndarray, "frame"], centers: Float[np.ndarray, "frame 3"]
) -> Iterator[range]:
    """Yield the frames of each stance phase, split where the foot slides too far."""
    for start, end in runs(stance):
        skate = np.linalg.norm(np.diff(centers[start:end], axis=0), axis=1).sum()
        count = max(1, min(int(np.ceil(skate / STRIDE_M)), (end - start) // SHORTEST_PHASE_FRAMES))
        cuts = np.linspace(start, end, count + 1).round().astype(int).tolist()
        yield from (range(*pair) for pair in pairwise(cuts))


def _make_room_to_swing(
    before: range, after: range, centers: Float[np.ndarray, "frame 3"]
) -> tuple[range, range] | None:
    """Shorten two phases until the foot has time to swing between them; None if they are too short."""
    step_m = np.linalg.norm(centers[after].mean(0) - centers[before].mean(0))
    lacking = max(int(np.ceil(np.sqrt(6 * step_m / SWING_M_S2) * RATE_HZ)) - (after.start - before.stop), 0)
    spare = [max(len(phase) - SHORTEST_PHASE_FRAMES, 0) for phase in (before, after)]
    if lacking > sum(spare):
        return None
    early = int(np.clip(lacking // 2, lacking - min(spare[1], lacking), spare[0]))
    return range(before.start, before.stop - early), range(after.start + lacking - early, after.stop)


def _speed(points: Float[np.ndarray, "frame foot 3"]) -> Float[np.ndarray, "frame foot"]:
    if len(points) < 2:
        return np.zeros(points.shape[:2])
    speed = np.linalg.norm(np.gradient(points, 1 / RATE_HZ, axis=0), axis=-1)
    return ndimage.median_filter(speed, size=(3, 1))
