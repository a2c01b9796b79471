"""Pictures of a surface that is known: what one shows, as seen from another's camera.

A `View` is a small grey picture with its camera and the surface's depth in it. `warp` brings one into
another's camera, `flow_matches` compares both there by optical flow.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import RayCaster, render_view
from stages.estimate_depth.landmarks import Matches

SHORTER_PX = 240
"""Shorter side of the pictures that are compared, pixels: optical flow is fast there and still sub-pixel."""
STRIDE_PX, MARGIN_PX = 8, 5
"""One pixel in so many, each way, is matched, away from the margin."""
LONGEST_PX = 20.0
"""Longer flow between pictures of one camera is none, pixels."""
OCCLUDED_SHARE, OCCLUDED_M = 0.03, 0.03
"""A point is hidden where the surface lies nearer by this share of its depth and this many metres."""
MIN_KNOWN = 0.05
"""Share of a picture that must be known from the other's camera for both to be compared."""
CLAHE_CLIP, CLAHE_TILES = 4.0, (6, 8)
"""Local contrast equalisation before flow: clip limit and tiles (columns, rows)."""


@dataclass(frozen=True)
class View:
    """One small picture, its camera, and the surface in it."""

    gray: UInt8[np.ndarray, "height width"]
    """Contrast equalised."""
    intrinsics: Float[np.ndarray, "3 3"]
    world_from_camera: Float[np.ndarray, "4 4"]
    depth: Float[np.ndarray, "height width"]
    """Of the surface, metres; 0 where there is none."""


@dataclass(frozen=True)
class Warped:
    """One picture as seen from another camera."""

    there: Float[np.ndarray, "height width 2"]
    """Pixel of the source that each pixel shows."""
    known: Bool[np.ndarray, "height width"]
    """Where the source sees the same surface."""


def small_gray(color: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "small_height small_width"]:
    """Reduce a picture and equalise its contrast."""
    scale = min(1.0, SHORTER_PX / min(color.shape[:2]))
    size = round(color.shape[0] * scale), round(color.shape[1] * scale)
    gray = cv2.resize(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), size[::-1], interpolation=cv2.INTER_AREA)
    return cv2.createCLAHE(CLAHE_CLIP, CLAHE_TILES).apply(gray)


def view_of(
    gray: UInt8[np.ndarray, "height width"],
    intrinsics: Float[np.ndarray, "3 3"],
    world_from_camera: Float[np.ndarray, "4 4"],
    caster: RayCaster,
) -> View:
    """Look at the surface from a camera; intrinsics in pixels of the small picture."""
    depth, _ = render_view(caster, world_from_camera, intrinsics, *gray.shape)
    return View(gray, intrinsics, world_from_camera, depth)


def warp(target: View, source: View) -> Warped:
    """Find where a source shows what each pixel of a target shows."""
    points = cameras.back_project(target.depth, target.intrinsics).reshape(-1, 3)
    moved = rigid.apply(rigid.inverse(source.world_from_camera) @ target.world_from_camera, points)
    there, z = cameras.project(moved, source.intrinsics)
    there, z = there.astype(np.float32).reshape(*target.gray.shape, 2), z.reshape(target.gray.shape)
    seen = cv2.remap(source.depth, there[..., 0] - 0.5, there[..., 1] - 0.5, cv2.INTER_NEAREST, borderValue=0)
    near = np.abs(seen - z) < OCCLUDED_M + OCCLUDED_SHARE * z
    return Warped(there, (target.depth > 0) & (z > 0.1) & (seen > 0) & near)


def flow_matches(target: View, source: View) -> Matches:
    """Match a target's pixels with points of the world by what the source shows of them.

    The target's camera is a guess: the source's picture is brought there, flow measures how far off it is.
    """
    warped = warp(target, source)
    if warped.known.mean() < MIN_KNOWN:
        return Matches(np.zeros((0, 2)), np.zeros((0, 3)))
    shown = cv2.remap(source.gray, warped.there[..., 0] - 0.5, warped.there[..., 1] - 0.5, cv2.INTER_LINEAR)
    shown = np.where(warped.known, shown, target.gray)
    dense = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow = dense.calc(shown, target.gray, np.zeros(0, np.float32))
    inner = tuple(slice(MARGIN_PX, side - MARGIN_PX, STRIDE_PX) for side in shown.shape)
    rows, columns = np.mgrid[inner].reshape(2, -1)
    start, moved = np.stack([columns, rows], axis=-1) + 0.5, flow[rows, columns]
    good = warped.known[rows, columns] & (np.abs(moved).max(1) < LONGEST_PX)
    rays = cameras.unproject(start[good], target.intrinsics) * target.depth[rows, columns][good, None]
    return Matches(start[good] + moved[good], rigid.apply(target.world_from_camera, rays))
