"""Cover the reconstruction's surfaces with Gaussians, in the colors of the pictures (`splats`).

`sample_surfaces` puts many points on the surface that all videos share and on what single videos saw
elsewhere (a chair that is moved between sessions). `observe` projects them into some pictures of every video
that shows them and averages colors, near views most, and fits each video's exposure. `subsample` keeps most
of them where colors change fast and where cameras looked: there a coarse cover costs most.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from pipeline.data import ply
from pipeline.data.clips import usable_depth
from pipeline.fields import fields, gaussians, marching_cubes
from pipeline.fields.fields import Field
from pipeline.fields.gaussians import Gaussians, Splats, SurfaceSamples
from pipeline.geometry import cameras, rigid
from stages.refine_gaussians.config import GaussianCounts
from stages.refine_gaussians.views import AGENT, UNKNOWN, DrawnVideo

CANDIDATES = 6
"""points that are sampled for each that is kept"""
REACH_M = 0.05
"""a point is seen where measured depth is this near at a distance of 1 m, twice that at 2 m"""
PLAIN = 0.02
"""color differences between neighbours, 0..1, that count as none"""
WIDEST = 0.9
"""Gaussians are no wider than this quantile of their spacing: isolated points stay small"""
EVEN = 0.4
"""share of the Gaussians that is spread evenly"""
SHELL_M = 0.12
"""unseen points this near to a seen one are its back, and left out"""
MIN_SEEN = 100
"""points without which a video's exposure is not fitted"""
RIDGE = 0.001
"""pulls exposures to the identity where colors do not determine them"""
NEAREST_M = 0.2
"""nearer points are not looked at"""
NEIGHBOURS = 6
"""of a point, over which its color gradient is averaged"""
SPACING_NEIGHBOUR, MIN_SPACING_M = 4, 0.001
"""the distance to this neighbour is a point's spacing, at least this"""
CURVE_CELL_M, CURVE_BITS = 0.005, 20
"""cells of the space-filling curve, and bits of their numbers"""


@dataclass(frozen=True)
class ObservedColors:
    """Colors and visibility of points in the pictures."""

    color: Float[np.ndarray, "point 3"]
    """0..1, in the light of the surface's own colors; those where never seen"""
    weight: Float[np.ndarray, "point"]
    """sum of 1 / depth squared over the pictures that show a point"""
    through: Float[np.ndarray, "point"]
    """the same over the pictures that show what lies behind it: it was moved, or never there"""
    appearance: Float[np.ndarray, "video 3 4"]
    """what turns these colors into each video's"""


@dataclass(frozen=True)
class CoveredScene:
    """The scene in Gaussians."""

    gaussians: Gaussians
    stands: Bool[np.ndarray, "row point"]
    """which of them each video shows and, in the last row, which all share"""
    appearance: Float[np.ndarray, "video 3 4"]
    """each video's exposure"""


def splats(
    reconstruction: Path,
    counts: GaussianCounts,
    videos: Sequence[DrawnVideo],
    frames: int,
    rng: np.random.Generator,
) -> Splats:
    """Cover a reconstruction; the agent's Gaussians take their skinning weights from its body."""
    loaded = fields.load(reconstruction)
    codes = [loaded.video_code(video.id) for video in videos if video.appearance is not None]
    room = scene(loaded.scene, codes, counts.scene, videos, frames, rng)
    agent = gaussians.from_mesh(ply.read_ply(reconstruction / "agent.ply"), counts.agent, rng)
    with torch.no_grad():
        weights = loaded.body.weights(agent.means)
    rest, stands = loaded.body.agent_from_bone_rest, torch.from_numpy(room.stands)
    made = Splats(room.gaussians, agent, weights, rest, len(codes), stands)
    made.appearance.data.copy_(torch.from_numpy(room.appearance))
    return made


def scene(
    field: Field,
    codes: Sequence[int],
    number: int,
    videos: Sequence[DrawnVideo],
    frames: int,
    rng: np.random.Generator,
) -> CoveredScene:
    """Cover the shared scene and what single videos saw, with colors of about ``frames`` pictures."""
    points, layer, stands = sample_surfaces(field, codes, CANDIDATES * number, rng)
    seen = observe(points, stands, videos, frames)
    chosen, spacing_m = subsample(points.points, layer, seen, number, rng)
    surface = points.points[chosen], points.normal[chosen], seen.color[chosen]
    cloud = gaussians.surface_gaussians(*surface, spacing_m)
    return CoveredScene(cloud, stands[:, chosen], seen.appearance)


def sample_surfaces(
    field: Field, codes: Sequence[int], number: int, rng: np.random.Generator
) -> tuple[SurfaceSamples, Int[np.ndarray, "point"], Bool[np.ndarray, "row point"]]:
    """Sample points on all surfaces: ``number`` on the shared one and as densely on those of single videos.

    Returns the points, on whose surface each lies (-1: the shared one) and where it stands, as
    `CoveredScene.stands`.
    """
    shared = marching_cubes.extract_scene(field, -1, field.lattice_m)
    keep_own = list(codes) if field.fused else []
    parts, layers = [gaussians.sample_surface(shared, number, rng)], [np.full(number, -1)]
    for code in keep_own:
        moved = marching_cubes.extract_moved(field, code)
        count = round(moved.area_m2 / parts[0].spacing_m ** 2)
        if count:
            parts.append(gaussians.sample_surface(moved, count, rng))
            layers.append(np.full(count, code))
    layer = np.concatenate(layers)
    points, normal, color = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("points", "normal", "color")
    )
    together = SurfaceSamples(points, normal, color, parts[0].spacing_m)
    stands = np.stack([(layer == -1) | (layer == code) for code in (*codes, -1)])
    for row, code in zip(stands, keep_own, strict=False):
        assert field.fused is not None, "a scene without fused geometry has no surfaces of single videos"
        own = field.fused.is_own(torch.from_numpy(together.points), code).numpy() & (layer == -1)
        row[own] = marching_cubes.on_surface(field, together.points[own], code)
    return together, layer, stands


def observe(
    samples: SurfaceSamples, stands: Bool[np.ndarray, "row point"], videos: Sequence[DrawnVideo], frames: int
) -> ObservedColors:
    """Average the pictures' colors at points; fit each video's exposure to the colors that points have."""
    points, color = samples.points, samples.color
    videos = [video for video in videos if video.appearance is not None]
    total, appearance = np.zeros_like(color), np.tile(np.eye(3, 4), (len(videos), 1, 1))
    weight, through = np.zeros(len(points)), np.zeros(len(points))
    every = max(1, sum(len(video.usable_frames()) for video in videos) // frames)
    for video in videos:
        sums, weights = np.zeros_like(color), np.zeros(len(points))
        for look in _looks(samples, stands[video.appearance], video, every):
            sums[look.shown] += look.shown_weight[:, None] * look.color
            weights[look.shown] += look.shown_weight
            through[look.through] += look.through_weight
        shown = weights > 0
        if shown.sum() < MIN_SEEN:
            continue
        mean = sums[shown] / weights[shown, None]
        ours = exposure(color[shown], mean, weights[shown])
        appearance[video.appearance] = ours
        total[shown] += weights[shown, None] * ((mean - ours[:, 3]) @ np.linalg.inv(ours[:, :3]).T)
        weight += weights
    mean = np.clip(total / np.maximum(weight, 1e-9)[:, None], 0, 1)
    return ObservedColors(np.where(weight[:, None] > 0, mean, color), weight, through, appearance)


def exposure(
    source: Float[np.ndarray, "point 3"],
    target: Float[np.ndarray, "point 3"],
    weight: Float[np.ndarray, "point"],
) -> Float[np.ndarray, "3 4"]:
    """Fit the affine map of colors from source to target, near the identity where it is undetermined."""
    share = weight / weight.sum()
    inputs = np.concatenate([source, np.ones((len(source), 1))], axis=1)
    normal = (inputs * share[:, None]).T @ inputs + RIDGE * np.eye(4)
    return np.linalg.solve(normal, (inputs * share[:, None]).T @ target + RIDGE * np.eye(4, 3)).T


@dataclass(frozen=True)
class _Look:
    """What one picture shows: points and what lies behind points, with their weights."""

    shown: Int[np.ndarray, "shown"]
    color: Float[np.ndarray, "shown 3"]
    shown_weight: Float[np.ndarray, "shown"]
    through: Int[np.ndarray, "through"]
    through_weight: Float[np.ndarray, "through"]


def _looks(samples: SurfaceSamples, stands: np.ndarray, video: DrawnVideo, every: int) -> Iterator[_Look]:
    """Project the points of a video into some of its frames; back faces and the animal's pixels show none."""
    clip, masks = video.clip, video.masks
    homogeneous = np.pad(samples.points, ((0, 0), (0, 1)), constant_values=1).astype(np.float32)
    for frame in video.usable_frames()[::every]:
        world_from_camera = video.motion.world_from_camera[frame]
        points_camera = homogeneous @ rigid.inverse(world_from_camera)[:3].T.astype(np.float32)
        ahead = np.flatnonzero(stands & (points_camera[:, 2] > NEAREST_M))
        pixel, z = cameras.project(points_camera[ahead], clip.intrinsics[frame])
        (height, width), inside = clip.color_size, cameras.in_picture(pixel, z, clip.color_size)
        index, z, (column, row) = ahead[inside], z[inside], pixel[inside].astype(int).T
        depth = usable_depth(clip, frame)
        measured = depth[row * depth.shape[0] // height, column * depth.shape[1] // width]
        if masks is not None:
            label = masks[frame][row, column]
            measured = np.where((label == AGENT) | (label == UNKNOWN), 0, measured)
        towards = ((world_from_camera[:3, 3] - samples.points[index]) * samples.normal[index]).sum(-1) > 0
        shown = (measured > 0) & (np.abs(measured - z) < REACH_M * z) & towards
        through, weight = measured - z > 2 * REACH_M * z, 1 / z.astype(float) ** 2
        color = clip.color(frame)[row[shown], column[shown]] / 255
        yield _Look(index[shown], color, weight[shown], index[through], weight[through])


def subsample(
    points: Float[np.ndarray, "point 3"],
    layer: Int[np.ndarray, "point"],
    seen: ObservedColors,
    number: int,
    rng: np.random.Generator,
) -> tuple[Int[np.ndarray, "chosen"], Float[np.ndarray, "chosen"]]:
    """Choose about ``number`` points; returns their indices and their spacing on the same surface, metres.

    The error of a cover with spacing s is about (slope of colors * s)^2 times how often it is looked at; for
    a given number of points it is least where their density goes with the slope and the root of the visits.
    Points that more pictures saw through than saw are left out.
    """
    shown = seen.weight > 0
    gone = seen.through > seen.weight
    gone[~shown] |= np.isfinite(KDTree(points[shown]).query(points[~shown], distance_upper_bound=SHELL_M)[0])
    near = np.asarray(KDTree(points).query(points, NEIGHBOURS + 1)[1])[:, 1:]
    slope = np.abs(seen.color[near] - seen.color[:, None]).mean((1, 2)) + PLAIN
    visits = seen.weight / max(seen.weight.mean(), 1e-9)
    density = np.where(gone, 0, slope * np.sqrt(visits))
    share = EVEN * ~gone / (~gone).sum() + (1 - EVEN) * density / max(density.sum(), 1e-9)
    share = _capped(number * share, 1.0)
    order = np.argsort(_along_a_curve(points))
    steps = np.cumsum(share[order]) + rng.random()
    chosen = order[np.flatnonzero(np.diff(np.floor(steps), prepend=np.floor(steps[0] - share[order[0]])) > 0)]
    fourth_m = np.empty(len(chosen))
    for one in np.unique(layer[chosen]):
        own = layer[chosen] == one
        here = points[chosen[own]]
        distance_m = KDTree(here).query(here, min(SPACING_NEIGHBOUR + 1, len(here)))[0]
        fourth_m[own] = distance_m.reshape(len(here), -1)[:, -1]
    return chosen, np.clip(fourth_m, MIN_SPACING_M, np.quantile(fourth_m, WIDEST))


def _along_a_curve(points: Float[np.ndarray, "point 3"]) -> np.ndarray:
    """Return each point's place on a curve through space along which neighbours stay near (Morton's)."""
    cell = np.floor((points - points.min(0)) / CURVE_CELL_M).astype(np.uint64)
    place = np.zeros(len(points), np.uint64)
    for bit in range(CURVE_BITS):
        for axis in range(3):
            place |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return place


def _capped(share: np.ndarray, most: float) -> np.ndarray:
    """Cut shares at ``most`` and give the rest to the others."""
    total = share.sum()
    for _ in range(8):
        share = np.minimum(share * total / share.sum(), most)
    return share
