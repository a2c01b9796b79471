"""Cover the reconstruction's surfaces with Gaussians, and give those of the scene the colours that the pictures show.

`spread` puts many points on the surface that all videos share and on what single videos saw elsewhere (a chair that is
moved between sessions), `watch` looks at them in some pictures of every video that they stand in (what stands where the
sensor measured it counts, near views most) and tells colours and each video's exposure, `thin` keeps most of them where
colours change fast and where cameras looked: there a coarse cover costs most.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from pipeline.models import gaussians, surfaces
from pipeline.models.fields import Field
from pipeline.models.gaussians import Gaussians, Spread
from pipeline.space import cameras, rigid
from stages.refine_gaussians.refine import Sequence4D, usable_frames
from stages.refine_gaussians.views import AGENT, UNKNOWN


@dataclass(frozen=True)
class Cover:
    """How the scene's surface is covered."""

    candidates: int = 6
    """points that are looked at for each that is kept"""
    frames: int = 240
    """pictures that are looked at, over all videos"""
    reach_m: float = 0.05
    """a point is seen where measured depth is this near, and at 1 m; twice that at 2 m"""
    plain: float = 0.02
    """difference of neighbouring colours, 0..1, that counts as none"""
    widest: float = 0.9
    """Gaussians are no wider than this share of them would be: what stands alone is small"""
    even: float = 0.4
    """share of the Gaussians that lies evenly on all that is there"""
    shell_m: float = 0.12
    """what no picture showed and lies this near to something that one showed is its back, and left out"""


@dataclass(frozen=True)
class Seen:
    """What pictures tell of points."""

    color: Float[np.ndarray, "point 3"]
    """0..1, in the light of the surface's own colours; those where never seen"""
    weight: Float[np.ndarray, "point"]
    """sum of 1 / depth squared over the pictures that show a point"""
    through: Float[np.ndarray, "point"]
    """the same over the pictures that show what lies behind it: it was moved, or never there"""
    appearance: Float[np.ndarray, "video 3 4"]
    """what turns these colours into each video's"""


@dataclass(frozen=True)
class Covered:
    """The scene in Gaussians."""

    gaussians: Gaussians
    stands: Bool[np.ndarray, "row point"]
    """which of them each video shows and, in the last row, which all share"""
    appearance: Float[np.ndarray, "video 3 4"]
    """each video's exposure"""


def scene(
    field: Field, codes: Sequence[int], number: int, sequences: Sequence[Sequence4D], cover: Cover, rng: np.random.Generator
) -> Covered:
    """Cover the scene as all videos share it and as single ones saw it; ``codes`` are the videos' in the field."""
    points, layer, stands = spread(field, codes, cover.candidates * number, rng)
    seen = watch(points, stands, sequences, cover)
    kept, spacing_m = thin(points.points, layer, seen, number, cover, rng)
    cloud = gaussians.on_surface(points.points[kept], points.normal[kept], seen.color[kept], spacing_m)
    return Covered(cloud, stands[:, kept], seen.appearance)


def spread(
    field: Field, codes: Sequence[int], number: int, rng: np.random.Generator
) -> tuple[Spread, Int[np.ndarray, "point"], Bool[np.ndarray, "row point"]]:
    """Spread points over all surfaces: ``number`` on the shared one and as densely on those of single videos.

    Returns the points, on whose surface each lies (-1: the shared one) and where it stands, as `Covered.stands`.
    """
    shared, keep_own = surfaces.extract_scene(field, -1, field.lattice_m), list(codes) if field.fused else []
    spreads, layers = [gaussians.spread(shared, number, rng)], [np.full(number, -1)]
    for code in keep_own:
        moved = surfaces.extract_moved(field, code)
        count = round(moved.area_m2 / spreads[0].spacing_m ** 2)
        if count:
            spreads.append(gaussians.spread(moved, count, rng))
            layers.append(np.full(count, code))
    layer = np.concatenate(layers)
    joined = (np.concatenate([getattr(part, name) for part in spreads]) for name in ("points", "normal", "color"))
    together = Spread(*joined, spreads[0].spacing_m)
    stands = np.stack([(layer == -1) | (layer == code) for code in (*codes, -1)])
    for row, code in zip(stands, keep_own, strict=False):
        own = field.fused.is_own(torch.from_numpy(together.points), code).numpy() & (layer == -1)
        row[own] = surfaces.stands(field, together.points[own], code)
    return together, layer, stands


def watch(spread: Spread, stands: Bool[np.ndarray, "row point"], sequences: Sequence[Sequence4D], cover: Cover) -> Seen:
    """Average the pictures' colours at points; each video's exposure is fitted to the colours that the points have."""
    points, color = spread.points, spread.color
    videos = [sequence for sequence in sequences if sequence.video is not None]
    total, appearance = np.zeros_like(color), np.tile(np.eye(3, 4), (len(videos), 1, 1))
    weight, through = np.zeros(len(points)), np.zeros(len(points))
    every = max(1, sum(len(usable_frames(sequence)) for sequence in videos) // cover.frames)
    for sequence in videos:
        sums, weights = np.zeros_like(color), np.zeros(len(points))
        for look in _looks(spread, stands[sequence.video], sequence, every, cover.reach_m):
            sums[look.shown] += look.shown_weight[:, None] * look.color
            weights[look.shown] += look.shown_weight
            through[look.through] += look.through_weight
        shown = weights > 0
        if shown.sum() < 100:
            continue
        mean = sums[shown] / weights[shown, None]
        ours = exposure(color[shown], mean, weights[shown])
        appearance[sequence.video] = ours
        total[shown] += weights[shown, None] * ((mean - ours[:, 3]) @ np.linalg.inv(ours[:, :3]).T)
        weight += weights
    found = np.clip(total / np.maximum(weight, 1e-9)[:, None], 0, 1)
    return Seen(np.where(weight[:, None] > 0, found, color), weight, through, appearance)


def exposure(
    source: Float[np.ndarray, "point 3"], target: Float[np.ndarray, "point 3"], weight: Float[np.ndarray, "point"], ridge: float = 0.001
) -> Float[np.ndarray, "3 4"]:
    """Fit the affine map of colours from source to target, near the identity where they do not tell."""
    share = weight / weight.sum()
    inputs = np.concatenate([source, np.ones((len(source), 1))], axis=1)
    normal = (inputs * share[:, None]).T @ inputs + ridge * np.eye(4)
    return np.linalg.solve(normal, (inputs * share[:, None]).T @ target + ridge * np.eye(4, 3)).T


@dataclass(frozen=True)
class _Look:
    """What one picture shows: points and what lies behind points, with their weights."""

    shown: Int[np.ndarray, "shown"]
    color: Float[np.ndarray, "shown 3"]
    shown_weight: Float[np.ndarray, "shown"]
    through: Int[np.ndarray, "through"]
    through_weight: Float[np.ndarray, "through"]


def _looks(spread: Spread, stands: np.ndarray, sequence: Sequence4D, every: int, reach_m: float) -> Iterator[_Look]:
    """Look at the points that stand in a video in some of its frames; only what faces the camera is shown, and nothing at the animal."""
    clip, masks = sequence.recording.clip, sequence.recording.masks
    homogeneous = np.concatenate([spread.points, np.ones((len(spread.points), 1))], axis=1).astype(np.float32)
    for frame in usable_frames(sequence)[::every]:
        world_from_camera = sequence.motion.world_from_camera[frame]
        points_camera = homogeneous @ rigid.inverse(world_from_camera)[:3].T.astype(np.float32)
        ahead = np.flatnonzero(stands & (points_camera[:, 2] > 0.2))
        pixel, z = cameras.project(points_camera[ahead], clip.intrinsics[frame])
        height, width = clip.color_size
        inside = (pixel >= 0).all(-1) & (pixel[:, 0] < width) & (pixel[:, 1] < height)
        index, z, (column, row) = ahead[inside], z[inside], pixel[inside].astype(int).T
        depth = np.where(clip.confidence(frame) > 0, clip.depth(frame), 0)
        measured = depth[row * depth.shape[0] // height, column * depth.shape[1] // width]
        if masks is not None:
            label = masks[frame][row, column]
            measured = np.where((label == AGENT) | (label == UNKNOWN), 0, measured)
        towards = ((world_from_camera[:3, 3] - spread.points[index]) * spread.normal[index]).sum(-1) > 0
        shown = (measured > 0) & (np.abs(measured - z) < reach_m * z) & towards
        through, weight = measured - z > 2 * reach_m * z, 1 / z.astype(float) ** 2
        color = clip.color(frame)[row[shown], column[shown]] / 255
        yield _Look(index[shown], color, weight[shown], index[through], weight[through])


def thin(
    points: Float[np.ndarray, "point 3"], layer: Int[np.ndarray, "point"], seen: Seen, number: int, cover: Cover, rng: np.random.Generator
) -> tuple[np.ndarray, Float[np.ndarray, "kept"]]:
    """Choose about ``number`` points; returns their indices and how far the fourth of their neighbours on the same surface is, metres.

    The error of a cover with spacing s is about (slope of colours * s)^2 times how often it is looked at; for a given
    number of points it is least where their density goes with the slope and the root of the visits. What more pictures saw
    through than saw is left out.
    """
    shown = seen.weight > 0
    gone = seen.through > seen.weight
    gone[~shown] |= np.isfinite(cKDTree(points[shown]).query(points[~shown], distance_upper_bound=cover.shell_m)[0])
    near = cKDTree(points).query(points, 7)[1][:, 1:]
    slope = np.abs(seen.color[near] - seen.color[:, None]).mean((1, 2)) + cover.plain
    visits = seen.weight / max(seen.weight.mean(), 1e-9)
    wanted = np.where(gone, 0, slope * np.sqrt(visits))
    share = cover.even * ~gone / (~gone).sum() + (1 - cover.even) * wanted / max(wanted.sum(), 1e-9)
    share = _capped(number * share, 1.0)
    order = np.argsort(_along_a_curve(points))
    steps = np.cumsum(share[order]) + rng.random()
    chosen = order[np.flatnonzero(np.diff(np.floor(steps), prepend=np.floor(steps[0] - share[order[0]])) > 0)]
    fourth_m = np.empty(len(chosen))
    for one in np.unique(layer[chosen]):
        here = points[chosen[layer[chosen] == one]]
        fourth_m[layer[chosen] == one] = cKDTree(here).query(here, min(5, len(here)))[0].reshape(len(here), -1)[:, -1]
    return chosen, np.clip(fourth_m, 0.001, np.quantile(fourth_m, cover.widest))


def _along_a_curve(points: Float[np.ndarray, "point 3"], cell_m: float = 0.005) -> np.ndarray:
    """Return each point's place on a curve through space along which neighbours stay near (Morton's)."""
    cell, place = np.floor((points - points.min(0)) / cell_m).astype(np.uint64), np.zeros(len(points), np.uint64)
    for bit in range(20):
        for axis in range(3):
            place |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return place


def _capped(share: np.ndarray, most: float) -> np.ndarray:
    """Cut shares at ``most`` and give the rest to the others."""
    total = share.sum()
    for _ in range(8):
        share = np.minimum(share * total / share.sum(), most)
    return share
