"""Initialize Gaussians on the reconstruction's surfaces, in the colors of the pictures (`splats`).

`sample_surfaces` samples points densely on the shared surface and on surfaces of single videos (a chair moved
between sessions). `observe` projects them into pictures of every video, averages colors weighted by inverse
squared depth, and fits each video's exposure. `subsample` keeps more points where color gradients are large
and where cameras looked often: there sparse Gaussians cost most.
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
"""points sampled per point kept"""
DEPTH_TOLERANCE = 0.05
"""a point is visible if it agrees with the measured depth within this share of its depth"""
BASE_GRADIENT = 0.02
"""added to color differences between neighbors, 0..1"""
MAX_SPACING_QUANTILE = 0.9
"""spacings are clipped to this quantile: Gaussians at isolated points stay small"""
UNIFORM_SHARE = 0.4
"""share of the Gaussians that is spread uniformly"""
SHELL_M = 0.12
"""unseen points this near to a seen one are its back side and left out"""
MIN_SEEN = 100
"""visible points required to fit a video's exposure"""
RIDGE = 0.001
"""ridge regularization of exposures towards the identity"""
NEAREST_M = 0.2
"""near plane: nearer points are ignored"""
NEIGHBORS = 6
"""neighbors over which a point's color gradient is averaged"""
SPACING_NEIGHBOR, MIN_SPACING_M = 4, 0.001
"""a point's spacing is the distance to this neighbor, with this lower bound"""
MORTON_CELL_M, MORTON_BITS = 0.005, 20
"""cell size of the Morton curve, and bits per axis"""


@dataclass(frozen=True)
class ObservedColors:
    """Colors and visibility of points in the pictures."""

    color: Float[np.ndarray, "point 3"]
    """0..1, at the exposure of the surface's own colors, which unseen points keep"""
    weight: Float[np.ndarray, "point"]
    """sum of 1 / depth squared over the pictures in which a point is visible"""
    through: Float[np.ndarray, "point"]
    """the same over pictures that see through it: it was moved, or never existed"""
    appearance: Float[np.ndarray, "video 3 4"]
    """affine color transform from these colors to each video's"""


@dataclass(frozen=True)
class CoveredScene:
    """The initial Gaussians of the scene."""

    gaussians: Gaussians
    stands: Bool[np.ndarray, "row point"]
    """Gaussians present in each video and, in the last row, those of the shared scene"""
    appearance: Float[np.ndarray, "video 3 4"]
    """each video's exposure"""


def splats(
    reconstruction: Path,
    counts: GaussianCounts,
    videos: Sequence[DrawnVideo],
    frames: int,
    rng: np.random.Generator,
) -> Splats:
    """Initialize the Gaussians of a reconstruction; the agent's have the skinning weights of its body."""
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
    """Initialize Gaussians on shared and single videos' surfaces, colored from about ``frames`` pictures."""
    points, layer, stands = sample_surfaces(field, codes, CANDIDATES * number, rng)
    seen = observe(points, stands, videos, frames)
    chosen, spacing_m = subsample(points.points, layer, seen, number, rng)
    surface = points.points[chosen], points.normal[chosen], seen.color[chosen]
    cloud = gaussians.surface_gaussians(*surface, spacing_m)
    return CoveredScene(cloud, stands[:, chosen], seen.appearance)


def sample_surfaces(
    field: Field, codes: Sequence[int], number: int, rng: np.random.Generator
) -> tuple[SurfaceSamples, Int[np.ndarray, "point"], Bool[np.ndarray, "row point"]]:
    """Sample ``number`` points on the shared surface, and at the same density on those of single videos.

    Returns the points, the video code of each one's surface (-1: shared), and `CoveredScene.stands`.
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
    """Average the pictures' colors at points, and fit each video's exposure to the points' own colors."""
    points, color = samples.points, samples.color
    videos = [video for video in videos if video.appearance is not None]
    total, appearance = np.zeros_like(color), np.tile(np.eye(3, 4), (len(videos), 1, 1))
    weight, through = np.zeros(len(points)), np.zeros(len(points))
    every = max(1, sum(len(video.usable_frames()) for video in videos) // frames)
    for video in videos:
        sums, weights = np.zeros_like(color), np.zeros(len(points))
        for view in _observations(samples, stands[video.appearance], video, every):
            sums[view.shown] += view.shown_weight[:, None] * view.color
            weights[view.shown] += view.shown_weight
            through[view.through] += view.through_weight
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
    """Fit the affine color transform from source to target, regularized towards the identity."""
    share = weight / weight.sum()
    inputs = np.concatenate([source, np.ones((len(source), 1))], axis=1)
    normal = (inputs * share[:, None]).T @ inputs + RIDGE * np.eye(4)
    return np.linalg.solve(normal, (inputs * share[:, None]).T @ target + RIDGE * np.eye(4, 3)).T


@dataclass(frozen=True)
class _Observation:
    """Points visible in one picture and points that it sees through, with their weights."""

    shown: Int[np.ndarray, "shown"]
    color: Float[np.ndarray, "shown 3"]
    shown_weight: Float[np.ndarray, "shown"]
    through: Int[np.ndarray, "through"]
    through_weight: Float[np.ndarray, "through"]


def _observations(
    samples: SurfaceSamples, stands: np.ndarray, video: DrawnVideo, every: int
) -> Iterator[_Observation]:
    """Project a video's points into every ``every``-th frame, without back faces and the animal's pixels."""
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
        shown = (measured > 0) & (np.abs(measured - z) < DEPTH_TOLERANCE * z) & towards
        through, weight = measured - z > 2 * DEPTH_TOLERANCE * z, 1 / z.astype(float) ** 2
        color = clip.color(frame)[row[shown], column[shown]] / 255
        yield _Observation(index[shown], color, weight[shown], index[through], weight[through])


def subsample(
    points: Float[np.ndarray, "point 3"],
    layer: Int[np.ndarray, "point"],
    seen: ObservedColors,
    number: int,
    rng: np.random.Generator,
) -> tuple[Int[np.ndarray, "chosen"], Float[np.ndarray, "chosen"]]:
    """Choose about ``number`` points; return their indices and their spacing on the same surface, meters.

    The color error at spacing s is about (gradient * s)^2 times the observation weight. For a fixed number of
    points it is minimal at a density proportional to the gradient and the square root of the weight. Points
    that pictures see through more than they see them are left out.
    """
    shown = seen.weight > 0
    absent = seen.through > seen.weight
    absent[~shown] |= np.isfinite(
        KDTree(points[shown]).query(points[~shown], distance_upper_bound=SHELL_M)[0]
    )
    near = np.asarray(KDTree(points).query(points, NEIGHBORS + 1)[1])[:, 1:]
    gradient = np.abs(seen.color[near] - seen.color[:, None]).mean((1, 2)) + BASE_GRADIENT
    visits = seen.weight / max(seen.weight.mean(), 1e-9)
    density = np.where(absent, 0, gradient * np.sqrt(visits))
    uniform = UNIFORM_SHARE * ~absent / (~absent).sum()
    share = number * (uniform + (1 - UNIFORM_SHARE) * density / max(density.sum(), 1e-9))
    total = share.sum()
    for _ in range(8):  # redistribute what exceeds one
        share = np.minimum(share * total / share.sum(), 1.0)
    order = np.argsort(_morton_codes(points))
    steps = np.cumsum(share[order]) + rng.random()
    chosen = order[np.flatnonzero(np.diff(np.floor(steps), prepend=np.floor(steps[0] - share[order[0]])) > 0)]
    fourth_m = np.empty(len(chosen))
    for one in np.unique(layer[chosen]):
        own = layer[chosen] == one
        here = points[chosen[own]]
        distance_m = KDTree(here).query(here, min(SPACING_NEIGHBOR + 1, len(here)))[0]
        fourth_m[own] = distance_m.reshape(len(here), -1)[:, -1]
    return chosen, np.clip(fourth_m, MIN_SPACING_M, np.quantile(fourth_m, MAX_SPACING_QUANTILE))


def _morton_codes(points: Float[np.ndarray, "point 3"]) -> np.ndarray:
    """Return the Morton code of each point's cell."""
    cell = np.floor((points - points.min(0)) / MORTON_CELL_M).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            code |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code
