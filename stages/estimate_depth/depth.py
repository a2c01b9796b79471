"""Depth of every frame: the map's where the room is seen, the animal's by contact or by several views."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.core.progress import track
from pipeline.geometry import cameras, contact, subsampling
from pipeline.mapping import plane_sweep
from pipeline.mapping.plane_sweep import SweepView
from stages.estimate_depth import foreground, tracking
from stages.estimate_depth.foreground import ColorView
from stages.estimate_depth.tracking import MapViews

EDGE_SHARE = 0.06
"""Depth that changes by more than this share within 3 pixels is an edge of the map, which is less certain."""
RIM = np.ones((5, 5), np.uint8)
"""What may still be animal around what differs from the room: its depth is unknown, pixels."""
BACK_SHARE = 0.55
"""Height of an animal's back over its length."""
LARGEST_SHARE = 2.5
"""What is wider or higher than so many lengths is no animal: light, a curtain, a person."""
STRANGE_SHARE = 0.35
"""Share of a picture that differs from the map's from which on its camera was misplaced."""
CARRIED_S = 2.0
"""How long a place of contact holds where none is seen, seconds."""
SWEPT_PX, SOURCES, PLANES, ANGLES_DEG = 224, 4, 96, (3.0, 22.0)
"""Longer side of a turnaround's pictures in the sweep, pixels, frames that each one is compared with, planes,
and the angles, at the middle of the view, under which the frames see it, degrees."""
NEAREST_M, FARTHEST_SHARE = 0.25, 1.3
"""Nearest plane, metres, and the farthest, in units of the farthest of the map's depth."""
MIN_AGREEING = 2
"""Other frames that must confirm a depth; one more makes it certain."""

Learned = Callable[[int, Float[np.ndarray, "height width"], Bool[np.ndarray, "height width"]], np.ndarray]
"""Depth of one frame by a network, metres, given the map's and where it counts."""


@dataclass(frozen=True)
class FrameDepth:
    """Depth of one frame at the size of its view."""

    depth: Float[np.ndarray, "height width"]
    """Metres, 0 = unknown."""
    confidence: UInt8[np.ndarray, "height width"]
    """2 the map's, or confirmed by several frames; 1 at edges, or inferred; 0 unknown."""
    inferred: bool
    """Part of it is an animal's, by contact or by a network."""


def of_map(target: ColorView) -> FrameDepth:
    """Return the map's depth in a view."""
    depth = target.view.depth
    around = np.ones((3, 3), np.uint8)
    low = cv2.erode(np.where(depth > 0, depth, 0), around)
    steady = (low > 0) & (cv2.dilate(depth, around) - low < EDGE_SHARE * depth)
    return FrameDepth(depth, np.where(steady, 2, depth > 0).astype(np.uint8), False)


def of_session(
    shown: Sequence[ColorView],
    timestamp_s: Float[np.ndarray, "frame"],
    room: MapViews,
    walk: Sequence[ColorView],
    length_m: float,
    learned: Learned | None,
) -> list[FrameDepth | None]:
    """Return the depth of a session's frames: the room's from the map, the animal's where it stands.

    None where the picture differs from what the map shows there nearly everywhere.
    """
    by_view = {id(each.view): each for each in walk}
    times = subsampling.evenly(len(shown), foreground.OTHER_TIMES)
    masks, contacts = [], []
    for frame, target in enumerate(track(shown, "what stands before the room")):
        apart = times[np.abs(timestamp_s[times] - timestamp_s[frame]) > foreground.APART_S]
        seen = [by_view[id(view)] for view in tracking.walk_views(target.view, room)]
        before = foreground.foreground(target, seen, [shown[other] for other in apart])
        parts = None if before.mean() > STRANGE_SHARE else _parts(before)
        camera = target.view.intrinsics, target.view.world_from_camera
        masks.append(parts)
        contacts.append([contact.find(part, *camera, room.caster) for part in parts or ()])
    largest = [touched[0] if touched else None for touched in contacts]
    carried, found = contact.between(timestamp_s, largest, CARRIED_S), []
    for frame, seen in enumerate(zip(shown, masks, contacts, carried, strict=True)):
        found.append(None if masks[frame] is None else _with_animal(frame, *seen, length_m, learned))
    return found


def _parts(mask: Bool[np.ndarray, "height width"]) -> list[Bool[np.ndarray, "height width"]]:
    """Return connected parts, the largest first."""
    count, label = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    sizes = np.bincount(label.ravel(), minlength=count)[1:]
    order = 1 + np.argsort(-sizes, kind="stable")
    return [label == part for part in order if sizes[part - 1] >= contact.MIN_AREA_PX]


def _with_animal(frame, target: ColorView, parts, touched, carried, length_m, learned) -> FrameDepth:
    """Put what stands before the room into the map's depth; it is unknown around it."""
    room, view = of_map(target), target.view
    depth, confidence, inferred = room.depth.copy(), room.confidence.copy(), False
    union = np.zeros(depth.shape, bool)
    for part in parts:
        union |= cv2.dilate(part.astype(np.uint8), RIM) > 0
    depth[union], confidence[union] = 0, 0
    by_network = None if learned is None or not parts else learned(frame, room.depth, ~union)
    for part, each in zip(parts, touched, strict=True):
        point = each.point_world if each is not None and each.certain else carried
        if by_network is not None:
            own = np.where(part, by_network, 0)
        elif np.isfinite(point).all():
            camera = view.intrinsics, view.world_from_camera
            own = contact.depth_of(part, point, BACK_SHARE * length_m, *camera)
        else:
            continue
        own = np.where((room.depth > 0) & (own > room.depth), room.depth, own)
        rows, columns = np.nonzero(own)
        if not len(rows):
            continue
        extent_m = max(np.ptp(rows), np.ptp(columns)) * np.median(own[own > 0]) / view.intrinsics[0, 0]
        if extent_m < LARGEST_SHARE * length_m:
            depth[own > 0], confidence[own > 0], inferred = own[own > 0], 1, True
    return FrameDepth(depth, confidence, inferred)


def of_turnaround(shown: Sequence[ColorView], room: MapViews, walk: Sequence[ColorView]) -> list[FrameDepth]:
    """Return the depth of frames that circle an animal at rest: by several views, else the map's."""
    views = [_sweep_view(each) for each in shown]
    others = [_around(number, shown) for number in range(len(shown))]
    swept = []
    for number, each in enumerate(track(views, "depth by several views")):
        near = [views[other] for other in others[number]]
        reach = NEAREST_M, FARTHEST_SHARE * float(shown[number].view.depth.max(initial=1.0))
        swept.append(plane_sweep.sweep(each, near, reach, PLANES) if near else np.zeros_like(each.gray))
    by_view, found = {id(each.view): each for each in walk}, []
    for number, target in enumerate(track(shown, "what several views agree on")):
        near = [(swept[other], views[other]) for other in others[number]]
        agree = plane_sweep.agreement(swept[number], views[number], near)
        size = target.view.gray.shape[::-1]
        agree = cv2.resize(agree, size, interpolation=cv2.INTER_NEAREST)
        several = cv2.resize(swept[number], size, interpolation=cv2.INTER_NEAREST)
        known = agree >= MIN_AGREEING
        seen = [by_view[id(view)] for view in tracking.walk_views(target.view, room)]
        before = cv2.dilate(foreground.foreground(target, seen, []).astype(np.uint8), RIM) > 0
        mapped = of_map(target)
        depth = np.where(known, several, np.where(before, 0, mapped.depth))
        sure = np.clip(agree.astype(int) - MIN_AGREEING + 1, 0, 2)
        confidence = np.where(known, sure, np.where(depth > 0, 1, 0))
        found.append(FrameDepth(depth.astype(np.float32), confidence.astype(np.uint8), False))
    return found


def _sweep_view(shown: ColorView) -> SweepView:
    view = shown.view
    share = min(1.0, SWEPT_PX / max(view.gray.shape))
    size = round(view.gray.shape[0] * share), round(view.gray.shape[1] * share)
    gray = cv2.resize(view.gray, size[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
    intrinsics = cameras.scale_intrinsics(view.intrinsics, view.gray.shape, size)
    return SweepView(gray, intrinsics, view.world_from_camera)


def _around(number: int, shown: Sequence[ColorView]) -> list[int]:
    """Choose the frames that see the middle of a view under good angles, spread evenly over them."""
    view = shown[number].view
    known = view.depth[view.depth > 0]
    if not len(known):
        return []
    centres = np.stack([each.view.world_from_camera[:3, 3] for each in shown])
    middle = view.world_from_camera[:3, 3] + view.world_from_camera[:3, 2] * float(np.median(known))
    rays = centres - middle
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    angle = np.degrees(np.arccos(np.clip(rays @ rays[number], -1, 1)))
    fit = np.flatnonzero((angle > ANGLES_DEG[0]) & (angle < ANGLES_DEG[1]))
    fit = fit[np.argsort(angle[fit], kind="stable")]
    return [int(other) for other in fit[subsampling.evenly(len(fit), SOURCES)]]
