"""Warping pictures of a known surface between cameras.

A `View` is a small gray picture with its camera and the surface's depth. `warp` maps one view into another's
camera, and `flow_matches` measures the remaining displacement by optical flow.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import RayCaster, render_view
from pipeline.segmentation.recognizer import small
from stages.estimate_depth.landmarks import Matches

STRIDE_PX, MARGIN_PX = 8, 5
"""Stride of matched pixels, and margin of the picture without matches."""
MAX_FLOW_PX = 20.0
"""Largest valid flow between aligned pictures, pixels."""
OCCLUDED_SHARE, OCCLUDED_M = 0.03, 0.03
"""Depth difference at which a point is occluded: share of its depth plus meters."""
MIN_KNOWN = 0.05
"""Least overlap of two pictures for matching, share."""
CLAHE_CLIP, CLAHE_TILES = 4.0, (6, 8)
"""CLAHE before flow: clip limit and tiles (columns, rows)."""


@dataclass(frozen=True)
class View:
    """One small picture, its camera, and the surface's depth."""

    gray: UInt8[np.ndarray, "height width"]
    """Contrast equalized."""
    intrinsics: Float[np.ndarray, "3 3"]
    world_from_camera: Float[np.ndarray, "4 4"]
    depth: Float[np.ndarray, "height width"]
    """Of the surface, meters; 0 where there is none."""


def small_gray(color: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "small_height small_width"]:
    """Reduce a picture and equalize its contrast."""
    gray = small(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY))
    return cv2.createCLAHE(CLAHE_CLIP, CLAHE_TILES).apply(gray)


def view_of(
    gray: UInt8[np.ndarray, "height width"],
    intrinsics: Float[np.ndarray, "3 3"],
    world_from_camera: Float[np.ndarray, "4 4"],
    caster: RayCaster,
) -> View:
    """Render the surface's depth for a picture; intrinsics in pixels of the small picture."""
    depth, _ = render_view(caster, world_from_camera, intrinsics, *gray.shape)
    return View(gray, intrinsics, world_from_camera, depth)


def warp(
    target: View, source: View
) -> tuple[Float[np.ndarray, "height width 2"], Bool[np.ndarray, "height width"]]:
    """Return the source pixel of each target pixel's surface point, and where the source sees that point."""
    points = cameras.back_project(target.depth, target.intrinsics).reshape(-1, 3)
    moved = rigid.apply(rigid.inverse(source.world_from_camera) @ target.world_from_camera, points)
    there, z = cameras.project(moved, source.intrinsics)
    there, z = there.astype(np.float32).reshape(*target.gray.shape, 2), z.reshape(target.gray.shape)
    seen = cv2.remap(source.depth, there[..., 0] - 0.5, there[..., 1] - 0.5, cv2.INTER_NEAREST, borderValue=0)
    near = np.abs(seen - z) < OCCLUDED_M + OCCLUDED_SHARE * z
    return there, (target.depth > 0) & (z > 0.1) & (seen > 0) & near


def flow_matches(target: View, source: View) -> Matches:
    """Match a target's pixels with world points seen in the source.

    The source is warped to the target's approximate camera; flow measures the remaining displacement.
    """
    there, known = warp(target, source)
    if known.mean() < MIN_KNOWN:
        return Matches(np.zeros((0, 2)), np.zeros((0, 3)))
    shown = np.where(known, cameras.sample_bilinear(source.gray, there), target.gray)
    dense = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow = dense.calc(shown, target.gray, np.zeros(0, np.float32))
    inner = tuple(slice(MARGIN_PX, side - MARGIN_PX, STRIDE_PX) for side in shown.shape)
    rows, columns = np.mgrid[inner].reshape(2, -1)
    start, moved = cameras.pixel_centers(rows, columns), flow[rows, columns]
    good = known[rows, columns] & (np.abs(moved).max(1) < MAX_FLOW_PX)
    rays = cameras.unproject(start[good], target.intrinsics) * target.depth[rows, columns][good, None]
    return Matches(start[good] + moved[good], rigid.apply(target.world_from_camera, rays))
