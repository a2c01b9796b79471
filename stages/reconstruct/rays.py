"""Convert recordings into a compact store of rays, so that optimization need not read pictures.

`collect` reads each frame of one video once and keeps a few pixels of it: some anywhere, some on and around
the agent. `Views` keeps thumbnails of each frame (depth, distance from the agent's mask, occluders) for the
losses of the posed surface. `join` puts the videos on one frame axis.
"""

import functools
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int8, UInt8
from numpy.random import Generator
from scipy.ndimage import minimum_filter
from torch import Tensor
from torch.nn import functional

from pipeline.data import npz
from pipeline.data.clips import Clip, Masks, usable_depth
from pipeline.data.features import STRIDE_PX as FEATURE_STRIDE_PX
from pipeline.data.flow import STRIDE_PX as FLOW_STRIDE_PX
from pipeline.geometry import cameras
from pipeline.geometry.flying_pixels import supported
from stages.reconstruct.config import PixelSampling

AGENT, UNKNOWN, NOT_AGENT = 255, 128, 0
"""values of a mask"""
RING_PX, RING_SHARE = 10, 0.25
"""width of the ring around the mask, color pixels, and its share of the pixels kept for the agent"""
MIN_SLOPE = 0.15
"""lower bound of the slope: normals of noisy depth are unreliable on oblique surfaces"""
EDGE_M, EDGE_SHARE = 0.1, 0.05
"""depth that changes by more than this within 3 pixels, plus this share of itself, is an edge"""
THUMBNAIL = 4
"""downsampling factor of thumbnails from color pixels"""
FAR_PX = 255.0
"""distances from the mask are clamped here"""
NEAREST_M = 0.15
"""nearer depth is not trusted"""
MIN_CONFIDENCE = 2
"""least confidence of depth used from a recording without a depth sensor: from the map or several views"""


@dataclass(frozen=True)
class Rays:
    """Pixels and their measurements."""

    frame: Int[Tensor, "ray"]
    direction: Float[Tensor, "ray 3"]
    """camera axes, z = 1"""
    depth: Float[Tensor, "ray"]
    """meters along z; 0 = unknown"""
    slope: Float[Tensor, "ray"]
    """|normal . direction|: meters towards the surface per meter of depth"""
    color: UInt8[Tensor, "ray 3"]
    feature: Int8[Tensor, "ray 16"]
    """unit-length features times 127"""
    label: UInt8[Tensor, "ray"]
    """255 agent, 0 not, 128 unknown"""
    flow_px: Float[Tensor, "ray 2"]
    """where the pixel is ``flow_gap`` frames later, color pixels, absolute"""
    flow_confidence: UInt8[Tensor, "ray"]
    flow_gap: Int8[Tensor, "ray"]

    def __len__(self) -> int:
        return len(self.frame)

    def at(self, index: Int[Tensor, "ray"]) -> "Rays":
        """Select rays."""
        return Rays(*(getattr(self, field.name)[index] for field in fields(self)))


@dataclass(frozen=True)
class Views:
    """Intrinsics and thumbnails of each frame; smaller ones lie in the upper left corner."""

    intrinsics: Float[Tensor, "frame 3 3"]
    """color pixels"""
    size_px: Float[Tensor, "frame 2"]
    """width and height of the picture, color pixels"""
    depth: Float[Tensor, "frame height width"]
    """meters, half precision; 0 = unknown"""
    outside_px: Float[Tensor, "frame height width"]
    """color pixels outside the mask, negative inside, half precision; `FAR_PX` = farther or no mask"""
    occluder: Float[Tensor, "frame height width"]
    """depth of possible occluders of the agent (`occluder_depth`)"""
    agent_seen: Bool[Tensor, "frame"]
    """the mask of this frame can be trusted"""


@dataclass(frozen=True)
class RayStore:
    """The rays of all videos, split by purpose, on one frame axis."""

    scene: Rays
    """anywhere in the picture except on the agent; none of the turnaround"""
    agent: Rays
    """on the agent's mask and in a ring around it"""
    views: Views

    @functools.cached_property
    def farthest_m(self) -> float:
        """The largest measured depth, meters."""
        return float(self.views.depth.max())


@dataclass(frozen=True)
class RaySource:
    """One video's inputs."""

    clip: Clip
    features: Float[np.ndarray, "frame height width 16"]
    """at stride 8, memory-mapped"""
    masks: Masks | None = None
    flows: tuple[tuple[int, np.ndarray, np.ndarray], ...] = ()
    """(gap, forward flow [frame height width 2] at stride 4, confidence), memory-mapped"""
    has_scene: bool = True
    """False for the turnaround, whose cameras are known relative to the agent only"""


def collect(source: RaySource, sampling: PixelSampling, rng: Generator) -> RayStore:
    """Read every frame of a video once; frames count from 0."""
    clip, masks, scene, agent, thumbnails = source.clip, source.masks, [], [], []
    visible = np.zeros(len(clip), bool) if masks is None else masks.visible.astype(bool)
    for frame in range(len(clip)):
        depth, slope = trusted_depth(clip, frame)
        mask = np.zeros(clip.color_size, np.uint8) if masks is None else masks[frame]
        if source.has_scene:
            place = _choose(mask == NOT_AGENT, sampling.scene_per_frame, rng)
            scene.append(_read(source, frame, mask, depth, slope, place, rng))
        if visible[frame]:
            place = choose_agent_pixels(mask, near_agent(mask, RING_PX), sampling.agent_per_frame, rng)
            agent.append(_read(source, frame, mask, thin_depth(clip, frame), slope, place, rng))
        small = (mask.shape[0] // THUMBNAIL, mask.shape[1] // THUMBNAIL)
        outside_px = mask_distance_px(mask, small) if visible[frame] else np.full(small, FAR_PX, np.float16)
        depth = cv2.resize(depth, small[::-1], interpolation=cv2.INTER_NEAREST_EXACT).astype(np.float16)
        thumbnails.append((depth, outside_px, occluder_depth(depth, outside_px)))
    depths, outsides, occluders = (torch.from_numpy(np.stack(part)) for part in zip(*thumbnails, strict=True))
    size_px = torch.tensor(clip.color_size[::-1]).float().expand(len(clip), 2)
    intrinsics = torch.from_numpy(clip.intrinsics).float()
    views = Views(intrinsics, size_px, depths, outsides, occluders, torch.from_numpy(visible))
    none = torch.zeros(0, dtype=torch.int64)
    parts = (scene or [agent[0].at(none)], agent or [scene[0].at(none)])
    scene, agent = (
        Rays(*(torch.cat([getattr(some, field.name) for some in part]) for field in fields(Rays)))
        for part in parts
    )
    return RayStore(scene, agent, views)


def join(stores: Iterable[RayStore], folder: Path | None, size: tuple[int, int] | None = None) -> RayStore:
    """Put videos on one frame axis; frame indices of later videos are shifted by the frames before them.

    The result lies in unnamed files in ``folder``, so that memory does not grow with the frames
    (`npz.Column`). All thumbnails get the ``size`` (height, width), by default that of the first store.
    """
    parts = [[npz.Column(folder) for _ in fields(kind)] for kind in (Rays, Rays, Views)]
    frames = 0
    for store in stores:
        height, width = size = size or (store.views.depth.shape[1], store.views.depth.shape[2])
        scene, agent = (replace(rays, frame=rays.frame + frames) for rays in (store.scene, store.agent))
        tables = scene, agent, _padded(store.views, height, width)
        for columns, table in zip(parts, tables, strict=True):
            for column, field in zip(columns, fields(table), strict=True):
                column.append(getattr(table, field.name).numpy())
        frames += len(store.views.intrinsics)
    scene, agent, views = ([torch.from_numpy(column.array()) for column in columns] for columns in parts)
    return RayStore(Rays(*scene), Rays(*agent), Views(*views))


def _padded(views: Views, height: int, width: int) -> Views:
    """Pad thumbnails at the right and bottom with unknown depth and no mask, to one size."""
    edge = (0, width - views.depth.shape[2], 0, height - views.depth.shape[1])
    depth, occluder = functional.pad(views.depth, edge), functional.pad(views.occluder, edge)
    outside_px = functional.pad(views.outside_px, edge, value=FAR_PX)
    return replace(views, depth=depth, occluder=occluder, outside_px=outside_px)


def occluder_depth(
    depth: Float[np.ndarray, "height width"], outside_px: Float[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width"]:
    """Fill unknown depth of a thumbnail with the smallest depth of neighbors off the agent."""
    off_agent = np.where((depth > 0) & (outside_px > 0), depth, np.inf)
    nearest = minimum_filter(off_agent.astype(np.float32), 3, mode="constant", cval=np.inf)
    return np.where((depth > 0) | np.isinf(nearest), depth, nearest).astype(depth.dtype)


def trusted_depth(
    clip: Clip, frame: int
) -> tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Return depth, meters (0 where its confidence is 0 or at edges), and each pixel's slope."""
    depth = usable_depth(clip, frame, nearest_m=NEAREST_M)
    if clip.mapped:
        depth[clip.confidence(frame) < MIN_CONFIDENCE] = 0
    directions = cameras.ray_directions(clip.depth_intrinsics[frame], *depth.shape).astype(np.float32)
    known = cv2.blur((depth > 0).astype(np.float32), (3, 3))
    smooth = cv2.blur(depth * 1.0, (3, 3)) / np.maximum(known, 1e-6)
    points = directions * smooth[..., None]
    across, down = np.zeros_like(points), np.zeros_like(points)
    across[:, 1:-1], down[1:-1] = points[:, 2:] - points[:, :-2], points[2:] - points[:-2]
    normal = np.cross(across, down)
    slope = np.abs((normal * directions).sum(-1)) / np.maximum(np.linalg.norm(normal, axis=-1), 1e-9)
    change = cv2.dilate(smooth, np.ones((3, 3))) - cv2.erode(smooth, np.ones((3, 3)))
    depth[change > EDGE_M + EDGE_SHARE * depth] = 0
    return depth, np.clip(slope, MIN_SLOPE, None).astype(np.float32)


def thin_depth(clip: Clip, frame: int) -> Float[np.ndarray, "height width"]:
    """Return depth, meters (0 = unknown), supported by neighbors; keeps edges: thin limbs are edges."""
    depth = clip.depth(frame).astype(np.float32)
    if clip.mapped:
        depth[clip.confidence(frame) < MIN_CONFIDENCE] = 0
    return np.where(supported(depth) & (depth >= NEAREST_M), depth, 0)


def near_agent(mask: UInt8[np.ndarray, "height width"], ring_px: int) -> Bool[np.ndarray, "height width"]:
    """Return the agent's mask and a ring around it."""
    kernel = np.ones((2 * ring_px + 1, 2 * ring_px + 1), np.uint8)
    return cv2.dilate((mask == AGENT).astype(np.uint8), kernel) > 0


def mask_distance_px(
    mask: UInt8[np.ndarray, "height width"], small: tuple[int, int]
) -> Float[np.ndarray, "small_height small_width"]:
    """Return the signed distance of a thumbnail's pixels to the mask's edge, color pixels, negative inside.

    It is computed at full resolution and then averaged.
    """
    outside = (mask == NOT_AGENT).astype(np.uint8)
    if outside.all():
        return np.full(small, FAR_PX, np.float16)
    beyond = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    within = cv2.distanceTransform(1 - outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    signed = np.where(outside, beyond - 0.5, 0.5 - within)
    height, width = (size * THUMBNAIL for size in small)
    limited = np.clip(signed[:height, :width], -FAR_PX, FAR_PX)
    return cv2.resize(limited, small[::-1], interpolation=cv2.INTER_AREA).astype(np.float16)


def _choose(
    allowed: Bool[np.ndarray, "height width"], count: int, rng: Generator
) -> Int[np.ndarray, "ray 2"]:
    """Choose up to ``count`` allowed pixels (row, column), without repetition."""
    flat = np.flatnonzero(allowed)
    picked = np.sort(rng.choice(flat, min(count, len(flat)), replace=False))
    return np.stack(np.unravel_index(picked, allowed.shape), axis=-1)


def choose_agent_pixels(
    mask: UInt8[np.ndarray, "height width"],
    near: Bool[np.ndarray, "height width"],
    count: int,
    rng: Generator,
) -> Int[np.ndarray, "ray 2"]:
    """Choose ``count`` pixels (row, column) on the agent, densely where it is thin, and around it."""
    inside = cv2.distanceTransform((mask == AGENT).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3).ravel()
    flat = np.flatnonzero(inside)
    number = min(count - int(count * RING_SHARE), len(flat))
    density = 1 / inside[flat]
    on_mask = rng.choice(flat, number, replace=False, p=density / density.sum()) if number else flat
    around = np.flatnonzero(near.ravel() & (inside == 0))
    in_ring = rng.choice(around, min(count - number, len(around)), replace=False)
    return np.stack(np.unravel_index(np.sort(np.concatenate([on_mask, in_ring])), mask.shape), axis=-1)


def _read(source: RaySource, frame: int, mask, depth, slope, place, rng: Generator) -> Rays:
    """Read the measurements at pixels (row, column) ``place`` of one frame."""
    clip, features, (row, column) = source.clip, source.features, place.T
    pixel = cameras.pixel_centers(row, column)
    direction = cameras.unproject(pixel, clip.intrinsics[frame])
    at_depth = cameras.project(direction, clip.depth_intrinsics[frame])[0].astype(int)
    x, y = np.clip(at_depth, 0, np.array(depth.shape[::-1]) - 1).T
    cell = _cells(place, FEATURE_STRIDE_PX, features[frame])
    feature = np.rint(np.asarray(features[frame])[cell].astype(np.float32) * 127).astype(np.int8)
    flow, confidence, gap = _read_flow(source, frame, place, rng)
    measured = (
        direction.astype(np.float32),
        depth[y, x],
        slope[y, x],
        clip.color(frame)[row, column],
        feature,
    )
    measured += (mask[row, column], (pixel + flow).astype(np.float32), confidence, gap)
    tensors = (torch.from_numpy(np.ascontiguousarray(array)) for array in measured)
    return Rays(torch.full((len(place),), frame), *tensors)


def _read_flow(source: RaySource, frame: int, place, rng: Generator):
    """Return displacement, confidence and gap at pixels (row, column), one gap for all of a frame."""
    possible = [flow for flow in source.flows if frame < len(flow[1])]
    if not possible:
        return np.zeros((len(place), 2)), np.zeros(len(place), np.uint8), np.ones(len(place), np.int8)
    gap, forward, confidence = possible[rng.integers(len(possible))]
    cell = _cells(place, FLOW_STRIDE_PX, forward[frame])
    found = np.asarray(forward[frame])[cell].astype(np.float64)
    return found, np.asarray(confidence[frame])[cell], np.full(len(place), gap, np.int8)


def _cells(place, stride_px: int, grid) -> tuple[Int[np.ndarray, "pixel"], ...]:
    """Return the cells of a grid that hold pixels (row, column); the last ones take the rest."""
    return tuple(np.minimum(place // stride_px, np.array(grid.shape[:2]) - 1).T)
