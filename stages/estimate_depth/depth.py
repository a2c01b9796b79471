"""Depth of every frame: rendered from the map for the room, by contact or stereo for the animal."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.core.progress import track
from pipeline.geometry import contact, rigid, subsampling
from pipeline.geometry.contact import StandingSurface
from pipeline.mapping import plane_sweep
from pipeline.mapping.plane_sweep import SweepView
from pipeline.segmentation.appearance import Appearance, components
from stages.estimate_depth import foreground, standing, tracking
from stages.estimate_depth.animal_parts import Part, follow
from stages.estimate_depth.foreground import ColorView
from stages.estimate_depth.tracking import MapViews
from stages.estimate_depth.views import View

EDGE_SHARE = 0.06
"""Depth range within 3 pixels, as a share of depth, above which a map pixel is an edge and less certain."""
DILATION = np.ones((5, 5), np.uint8)
"""Dilation of the foreground, pixels; depth there is unknown."""
BACK_SHARE = 0.55
"""Ratio of the height of an animal's back to its length."""
LARGEST_SHARE = 2.5
"""Largest extent of an animal in lengths; larger foreground is light, a curtain or a person."""
MAX_FOREGROUND = 0.35
"""Share of foreground, without what is recognized, above which the camera pose is taken as wrong."""
MAX_CONTACT_GAP_S = 2.0
"""Longest time over which contact points are interpolated, seconds."""
SWEPT_PX, SOURCES, PLANES, ANGLES_DEG = 224, 4, 96, (3.0, 22.0)
"""Plane sweep of turnarounds: longer side of pictures, pixels; source frames; planes; range of triangulation
angles at the middle of the view, degrees."""
REACH_QUANTILES, REACH = (0.05, 0.95), (0.5, 1.1)
"""Quantiles of the map's depth behind what stands in front of it, and factors on them: the planes' range."""
GRAY = np.uint8(128)
"""Gray level of the map in stereo of what stands in front of it."""
MIN_AGREEING = 2
"""Other frames that must agree on a depth; one more makes it certain."""
ROUNDS, MIN_PIXELS, DEPTH_RANGE_M = 8, 50, (0.1, 20.0)
"""Alignment of a network's depth: iterations of reweighted least squares, least map pixels, range of depth in
meters."""

DepthNet = Callable[[int, Float[np.ndarray, "height width"], Bool[np.ndarray, "height width"]], np.ndarray]
"""Depth of one frame by a network, meters, given the map's depth and where it is valid."""


@dataclass(frozen=True)
class FrameDepth:
    """Depth of one frame at the size of its view."""

    depth: Float[np.ndarray, "height width"]
    """Meters, 0 = unknown."""
    confidence: UInt8[np.ndarray, "height width"]
    """2 from the map, or confirmed by several frames; 1 at edges, or inferred; 0 unknown."""
    foreground: UInt8[np.ndarray, "height width"]
    """255 where the animal stands in front of the map, else 0."""


def of_map(target: ColorView) -> FrameDepth:
    """Return the map's depth in a view."""
    depth = target.view.depth
    around = np.ones((3, 3), np.uint8)
    low = cv2.erode(np.where(depth > 0, depth, 0), around)
    steady = (low > 0) & (cv2.dilate(depth, around) - low < EDGE_SHARE * depth)
    confidence = np.where(steady, 2, depth > 0).astype(np.uint8)
    return FrameDepth(depth, confidence, np.zeros_like(confidence))


def of_session(
    shown: Sequence[ColorView],
    timestamp_s: Float[np.ndarray, "frame"],
    room: MapViews,
    walk: Sequence[ColorView],
    standing: StandingSurface,
    length_m: float,
    depth_net: DepthNet | None,
    recognizer: Appearance | None = None,
) -> list[FrameDepth | None]:
    """Return the depth of a session's frames: from the map for the room, inferred for the animal.

    The animal is what the ``recognizer`` finds, without one all foreground. None for frames that differ
    too much from the map.
    """
    times = subsampling.evenly(len(shown), foreground.OTHER_TIMES)
    parts: list[list[Part] | None] = []
    for frame, target in enumerate(track(shown, "segmenting the foreground")):
        distant = times[np.abs(timestamp_s[times] - timestamp_s[frame]) > foreground.MIN_GAP_S]
        seen = [walk[number] for number in tracking.walk_views(target.view, room)]
        in_front = foreground.foreground(target, seen, [shown[other] for other in distant])
        found = [] if recognizer is None else foreground.recognize(recognizer, target, in_front)
        unknown = np.logical_and.reduce([in_front, *(~mask for mask, _ in found)])
        if unknown.mean() > MAX_FOREGROUND:
            parts.append(None)
            continue
        found = [(in_front, 1.0)] if recognizer is None else found
        parts.append([_part(mask, evidence, target.view, standing) for mask, evidence in found])
    animal = follow([each or [] for each in parts], [each.view for each in shown], timestamp_s)
    largest = [each and each.contact for each in animal]
    carried, found = contact.between(timestamp_s, largest, MAX_CONTACT_GAP_S), []
    for frame, target in enumerate(shown):
        own = frame, target, animal[frame] or Part((), (), 0.0), carried[frame], length_m, depth_net
        found.append(None if parts[frame] is None else _with_animal(*own))
    return found


def _part(
    mask: Bool[np.ndarray, "height width"], evidence: float, view: View, standing: StandingSurface
) -> Part:
    """Return a part, its ``evidence`` scaled from pixels to square meters where it stands."""
    blobs, camera = _blobs(mask), (view.intrinsics, view.world_from_camera)
    contacts = [contact.find(blob, *camera, standing) for blob in blobs]
    if contacts and contacts[0] is not None:
        z_m = rigid.apply(rigid.inverse(view.world_from_camera), contacts[0].point_world[None])[0, 2]
    else:
        behind = view.depth[mask & (view.depth > 0)]
        z_m = np.median(behind) if len(behind) else 0.0
    return Part(blobs, contacts, evidence * float(z_m / view.intrinsics[0, 0]) ** 2)


def _blobs(mask: Bool[np.ndarray, "height width"]) -> list[Bool[np.ndarray, "height width"]]:
    """Return the connected components, largest first."""
    found = components(mask, np.ones(mask.shape), mask.size)
    return [blob for blob, area_px in found if area_px >= contact.MIN_AREA_PX]


def _with_animal(frame, target: ColorView, animal: Part, carried, length_m, depth_net) -> FrameDepth:
    """Insert the animal's depth into the map's; around the animal it is unknown."""
    room, view, blobs = of_map(target), target.view, animal.blobs
    depth, confidence = room.depth.copy(), room.confidence.copy()
    shown = np.any([np.zeros(depth.shape, bool), *blobs], axis=0).astype(np.uint8)
    union = cv2.dilate(shown, DILATION) > 0
    depth[union], confidence[union] = 0, 0
    by_network = None if depth_net is None or not blobs else depth_net(frame, room.depth, ~union)
    for blob, each in zip(blobs, animal.contacts, strict=True):
        point = each.point_world if each is not None and each.certain else carried
        if by_network is not None:
            own = np.where(blob, by_network, 0)
        elif np.isfinite(point).all():
            camera = view.intrinsics, view.world_from_camera
            own = contact.depth_of(blob, point, BACK_SHARE * length_m, *camera)
        else:
            continue
        own = np.where((room.depth > 0) & (own > room.depth), room.depth, own)
        rows, columns = np.nonzero(own)
        if not len(rows):
            continue
        extent_m = max(np.ptp(rows), np.ptp(columns)) * np.median(own[own > 0]) / view.intrinsics[0, 0]
        if extent_m < LARGEST_SHARE * length_m:
            depth[own > 0], confidence[own > 0] = own[own > 0], 1
    return FrameDepth(depth, confidence, shown * np.uint8(255))


def of_turnaround(shown: Sequence[ColorView], room: MapViews, walk: Sequence[ColorView]) -> list[FrameDepth]:
    """Return the depth of frames that circle a resting animal: from the map, in front of it by stereo."""
    differing = []
    for frame in standing.references(len(shown)):
        seen = [walk[number] for number in tracking.walk_views(shown[frame].view, room)]
        differing.append(foreground.foreground(shown[frame], seen, []))
    in_front = standing.segment(shown, differing)
    views = [_sweep_view(each, mask) for each, mask in zip(shown, in_front, strict=True)]
    others = [_source_frames(number, shown) for number in range(len(shown))]
    reach = [_reach_m(each.view.depth, mask) for each, mask in zip(shown, in_front, strict=True)]
    swept, found = plane_sweep.depths(views, others, reach, PLANES), []
    for target, mask, both in zip(shown, in_front, swept, strict=True):
        size, mapped = target.view.gray.shape[::-1], of_map(target)
        several, agree = (cv2.resize(each, size, interpolation=cv2.INTER_NEAREST) for each in both)
        known = (agree >= MIN_AGREEING) & ((mapped.depth == 0) | (several < mapped.depth))
        depth = np.where(mask, np.where(known, several, 0), mapped.depth)
        sure = np.where(known, np.clip(agree.astype(int) - MIN_AGREEING + 1, 0, 2), 0)
        confidence = np.where(mask, sure, mapped.confidence)
        found.append(FrameDepth(depth.astype(np.float32), confidence.astype(np.uint8), mask * np.uint8(255)))
    return found


def _sweep_view(shown: ColorView, mask: Bool[np.ndarray, "height width"]) -> SweepView:
    """Return a view for stereo in which the map is gray: windows at thin parts match by their outlines."""
    view, side_px = shown.view, min(SWEPT_PX, max(shown.view.gray.shape))
    gray = np.where(mask, view.gray, GRAY)
    return SweepView.resized(gray, view.intrinsics, view.world_from_camera, side_px)


def _reach_m(
    mapped: Float[np.ndarray, "height width"], mask: Bool[np.ndarray, "height width"]
) -> tuple[float, float]:
    """Return the nearest and farthest plane: what stands in front of the map reaches it at its feet."""
    behind = mapped[mask & (mapped > 0)]
    low, high = np.quantile(behind if len(behind) else DEPTH_RANGE_M, REACH_QUANTILES)
    return REACH[0] * float(low), REACH[1] * float(high)


def _source_frames(number: int, shown: Sequence[ColorView]) -> list[int]:
    """Choose source frames with good triangulation angles at the middle of a view, evenly over the angles."""
    view = shown[number].view
    known = view.depth[view.depth > 0]
    if not len(known):
        return []
    centers = np.stack([each.view.world_from_camera[:3, 3] for each in shown])
    middle = view.world_from_camera[:3, 3] + view.world_from_camera[:3, 2] * float(np.median(known))
    rays = centers - middle
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    angle = np.degrees(np.arccos(np.clip(rays @ rays[number], -1, 1)))
    fit = np.flatnonzero((angle > ANGLES_DEG[0]) & (angle < ANGLES_DEG[1]))
    fit = fit[np.argsort(angle[fit], kind="stable")]
    return [int(other) for other in fit[subsampling.evenly(len(fit), SOURCES)]]


def aligned(
    inverse: Float[np.ndarray, "height width"],
    mapped: Float[np.ndarray, "height width"],
    counts: Bool[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"]:
    """Return metric depth from relative inverse depth: 1 / depth = scale * inverse + shift.

    Scale and shift are fitted to the map's depth (meters) where ``counts``, with Cauchy weights scaled by the
    median residual. Returns 0 where depth is invalid, and everywhere if too little counts or scale <= 0.
    """
    if counts.sum() < MIN_PIXELS:
        return np.zeros(inverse.shape, np.float32)
    known, target = inverse[counts].astype(float), 1 / mapped[counts].astype(float)
    design, weight = np.stack([known, np.ones_like(known)], axis=1), np.ones(len(known))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)[:, None]
        (scale, shift), *_ = np.linalg.lstsq(root * design, root[:, 0] * target, rcond=None)
        residual = np.abs(scale * known + shift - target)
        weight = 1 / (1 + (residual / max(float(np.median(residual)), 1e-6)) ** 2)
    if scale <= 0:
        return np.zeros(inverse.shape, np.float32)
    nearest, farthest = 1 / np.array(DEPTH_RANGE_M)
    fitted = np.clip(scale * inverse + shift, farthest, nearest)
    return np.where((fitted > farthest) & (fitted < nearest), 1 / fitted, 0).astype(np.float32)
