"""What touches the scene, found from the data: contact vertices, the feet they form, and when each foot
stands.

`find_contact_vertices` needs no list made by hand: a vertex counts that is among the closest to the scene in
a fair share of the frames. `detect_stance` then finds, for any motion, in which frames each foot carries
weight.
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
from pipeline.longterm.bodies import PosedSurface, SkinnedBody
from pipeline.longterm.short_motions import RATE_HZ, BodyMotion

TOUCH_M = 0.01
"""A vertex this close to the frame's closest ones touches too."""
CONTACT_FRAME_SHARE = 0.15
"""A vertex that touches in this share of the frames is a contact vertex."""
FOOT_M = 0.035
"""Contact vertices closer than this at rest belong to the same foot."""
SWING_M_S2 = 15.0
"""Acceleration that a swinging foot may need: a step of 10 cm takes 0.2 s."""
STRIDE_M = 0.25
"""A foot that glides further than this in one phase should stand more than once."""
GROUND_PERCENTILE, GROUND_ERROR_M = 20, 0.02
"""a foot's lowest heights are its ground; the reconstruction's floor is right within so much"""
STANCE_SPEED, STANCE_SPEED_M_S = 0.4, 0.08
"""a foot slower than this, as a share of the body's speed or in meters per second, stands"""
SLOWEST_FOOT, SLOWEST_FOOT_LIFTED = 0.8, 0.6
"""so does the slowest foot, below these shares: where feet should stand, and where they may not"""
LIFTED_M = 0.03
"""A foot higher than this above its ground is lifted."""
SHORTEST_PHASE_FRAMES = 3
"""Frames that a phase has at least."""


@dataclass(frozen=True)
class ContactVertices:
    """Where a body touches the world."""

    vertices: Int[np.ndarray, "vertex"]
    """contact vertices, indices into the body's surface"""
    foot: Int[np.ndarray, "vertex"]
    """foot that each contact vertex belongs to"""

    @property
    def feet(self) -> int:
        """How many feet there are."""
        return int(self.foot.max()) + 1 if len(self.foot) else 0

    def centres(self, vertices_world: Float[Tensor, "frame vertex 3"]) -> Float[Tensor, "frame foot 3"]:
        """Return the mean of each foot's vertices, given the contact vertices."""
        share = vertices_world.new_zeros(self.feet, len(self.foot))
        share[torch.from_numpy(self.foot), torch.arange(len(self.foot))] = 1
        return (share / share.sum(1, keepdim=True)) @ vertices_world

    def lowest(self, distance_m: Float[Tensor, "frame vertex"]) -> Float[Tensor, "frame foot"]:
        """Return how far each foot is from the scene, given the contact vertices' distances."""
        of_foot = (distance_m[:, np.flatnonzero(self.foot == foot)] for foot in range(self.feet))
        return torch.stack([distance.min(1).values for distance in of_foot], dim=1)


def find_contact_vertices(
    body: SkinnedBody, motions: list[BodyMotion], scenes: list[SignedDistance], *, max_frames: int = 400
) -> ContactVertices:
    """Find the contact vertices of a body from motions, each in its scene, and group them to feet.

    In each frame those vertices touch that are within 1 cm of the lowest percentile of the distances, so that
    a root that hovers or sinks a little does not matter.
    """
    surface = PosedSurface(body)
    every = max(1, sum(map(len, motions)) // max_frames)
    touches, frames = np.zeros(len(body.mesh.vertices)), 0
    for motion, scene in zip(motions, scenes, strict=True):
        part = motion[:: min(every, len(motion))]
        distance = scene.at(surface(*motion_tensors(part))).numpy()
        touches += (distance < np.percentile(distance, 1, axis=1, keepdims=True) + TOUCH_M).sum(0)
        frames += len(part)
    share = touches / max(frames, 1)
    chosen = np.flatnonzero(share > min(CONTACT_FRAME_SHARE, 0.5 * share.max()))
    return ContactVertices(chosen, _feet(np.asarray(body.mesh.vertices)[chosen], body.weights[chosen]))


def _feet(
    points: Float[np.ndarray, "vertex 3"], weights: Float[np.ndarray, "vertex bone"]
) -> Int[np.ndarray, "vertex"]:
    """Group close vertices of the same bone, and those that nearly touch; largest group first."""
    pairs = KDTree(points).query_pairs(FOOT_M, output_type="ndarray")
    bone, apart = weights.argmax(1), np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    pairs = pairs[(bone[pairs[:, 0]] == bone[pairs[:, 1]]) | (apart < FOOT_M / 3)]
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
    _, label = connected_components(graph, directed=False)
    order = np.argsort(-np.bincount(label), kind="stable")
    return np.argsort(order, kind="stable")[label]


def detect_stance(
    centres_world: Float[np.ndarray, "frame foot 3"],
    height_m: Float[np.ndarray, "frame foot"],
    root_world: Float[np.ndarray, "frame 3"],
    *,
    should_stand: bool = False,
) -> Bool[np.ndarray, "frame foot"]:
    """Return when each foot stands: near the scene, and hardly moving, or moving least of all feet and less
    than the body.

    ``height_m`` is the foot's distance from the scene. The paper lets the foot that moves less between two
    frames stand; an animal has more than two, so others stand too that are clearly slower than the body.
    Blinks under 0.1 s do not count. ``should_stand`` returns instead which feet should stand, in motion that
    glides: of those near the scene the one that moves least, however fast, as in the paper, and any that
    falls behind the body.
    """
    foot, body = _speed(centres_world), _speed(root_world[:, None])
    even = ndimage.uniform_filter1d(foot, round(RATE_HZ / 6), axis=0, mode="nearest")
    ground = np.percentile(height_m, GROUND_PERCENTILE, axis=0, keepdims=True)
    low = height_m < ground.clip(-GROUND_ERROR_M, GROUND_ERROR_M) + LIFTED_M
    least = np.where(low, even, np.inf)
    least = least == least.min(axis=1, keepdims=True)
    slow = foot < np.maximum(STANCE_SPEED * body, STANCE_SPEED_M_S)
    if should_stand:
        slow |= least | (even < SLOWEST_FOOT * body)
    else:
        slow |= least & (even < SLOWEST_FOOT_LIFTED * body)
    both = ndimage.binary_closing(slow & low, np.ones((3, 1)))
    stands = ndimage.binary_opening(np.pad(both, ((1, 1), (0, 0)), mode="edge"), np.ones((3, 1)))[1:-1]
    return enforce_swing_time(stands, centres_world) if should_stand else stands


def enforce_swing_time(
    stance: Bool[np.ndarray, "frame foot"], centres_world: Float[np.ndarray, "frame foot 3"]
) -> Bool[np.ndarray, "frame foot"]:
    """Shorten, part or leave out phases in which feet should stand, so that between two of them each foot can
    swing.

    A foot that glides on for more than `STRIDE_M` should stand more than once; from one place to another d
    metres away it takes sqrt(6 d / `SWING_M_S2`) seconds at least (a cubic in time, at rest at both ends).
    """
    standing = np.zeros_like(stance)
    for foot, centres in enumerate(np.moveaxis(centres_world, 1, 0)):
        phases: list[range] = []
        for phase in _split_phases(stance[:, foot], centres):
            while (
                phases
                and (pair := _make_room_to_swing(phases[-1], phase, centres)) is None
                and len(phase) > len(phases[-1])
            ):
                phases.pop()
            if not phases:
                phases.append(phase)
            elif pair is not None:
                phases[-1:] = pair
        standing[[frame for phase in phases for frame in phase], foot] = True
    return standing


def _split_phases(
    stance: Bool[np.ndarray, "frame"], centres: Float[np.ndarray, "frame 3"]
) -> Iterator[range]:
    """Yield the frames of each phase; those in which the foot goes too far, in parts."""
    edges = np.flatnonzero(np.diff(np.pad(stance.astype(np.int8), 1)))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        gone = np.linalg.norm(np.diff(centres[start:end], axis=0), axis=1).sum()
        count = max(1, min(int(np.ceil(gone / STRIDE_M)), (end - start) // SHORTEST_PHASE_FRAMES))
        cuts = np.linspace(start, end, count + 1).round().astype(int).tolist()
        yield from (range(*pair) for pair in pairwise(cuts))


def _make_room_to_swing(
    before: range, after: range, centres: Float[np.ndarray, "frame 3"]
) -> tuple[range, range] | None:
    """Give a foot time to swing between two phases; None where there is not that much."""
    away = np.linalg.norm(centres[after].mean(0) - centres[before].mean(0))
    lacking = max(int(np.ceil(np.sqrt(6 * away / SWING_M_S2) * RATE_HZ)) - (after.start - before.stop), 0)
    spare = [max(len(phase) - SHORTEST_PHASE_FRAMES, 0) for phase in (before, after)]
    if lacking > sum(spare):
        return None
    early = int(np.clip(lacking // 2, lacking - min(spare[1], lacking), spare[0]))
    return range(before.start, before.stop - early), range(after.start + lacking - early, after.stop)


def motion_tensors(motion: BodyMotion) -> tuple[Float[Tensor, "frame 4 4"], Float[Tensor, "frame bone 4 4"]]:
    """Return root and bones of a motion, metres, as torch tensors."""
    root, bones = np.asarray(motion.world_from_agent), np.asarray(motion.agent_from_bone)
    return torch.from_numpy(root).float(), torch.from_numpy(bones).float()


def _speed(points: Float[np.ndarray, "frame foot 3"]) -> Float[np.ndarray, "frame foot"]:
    if len(points) < 2:
        return np.zeros(points.shape[:2])
    speed = np.linalg.norm(np.gradient(points, 1 / RATE_HZ, axis=0), axis=-1)
    return ndimage.median_filter(speed, size=(3, 1))
