"""Photometric correspondences: optical flow from the rendered template to the picture."""

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.data.clips import Clip, Masks
from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import RayCaster
from pipeline.mapping.pose_optimization import MAP, Correspondences
from stages.register_videos.comparison import compare, local_contrast_normalization

SIGMA_PX = 16.0
"""Standard deviation of the flow, half-size pixels; large, since errors of hundreds of pixels correlate."""
MAX_CYCLE_ERROR_PX = 1.0
"""Largest forward-backward error, half-size pixels; rejects mirrors."""
STRIDE_PX, MARGIN_PX = 9, 4
"""Grid spacing of the matched pixels, and margin at the border, half-size pixels."""
MAX_FLOW_PX = 12
"""Longest valid flow, half-size pixels."""
MAX_DEPTH_ERROR_M = 0.12
"""Largest difference of measured depth at the flow's end and template depth at its start, meters."""
MIN_KNOWN_SHARE, MIN_PAIRS = 0.1, 20
"""Least share of pixels that show the template, and least number of matches."""
OUTSIDE_PX = 1e3
"""Flow assigned outside the picture."""


def flow_correspondences(
    clip: Clip, masks: Masks, caster: RayCaster, frame: int, world_from_camera: Float[np.ndarray, "4 4"]
) -> Correspondences | None:
    """Match one frame to the template rendered from its pose; None if too few pixels match."""
    pair = compare(clip, masks, caster, frame, world_from_camera)
    known, intrinsics = pair.known, pair.intrinsics
    if known.mean() < MIN_KNOWN_SHARE:
        return None
    flow, cycle_error_px = _flow(
        local_contrast_normalization(pair.rendered, known), local_contrast_normalization(pair.recorded, known)
    )
    inner = tuple(slice(MARGIN_PX, size - MARGIN_PX, STRIDE_PX) for size in known.shape)
    rows, columns = np.mgrid[inner].reshape(2, -1)
    start = cameras.pixel_centers(rows, columns)
    points_camera = cameras.back_project_pixels(
        start + flow[rows, columns], intrinsics, clip.depth(frame), clip.depth_intrinsics[frame]
    )
    z, template_z = points_camera[:, 2], pair.depth[rows, columns]
    good = (
        known[rows, columns]
        & (z > 0)
        & (np.abs(z - template_z) < MAX_DEPTH_ERROR_M)
        & (np.abs(flow[rows, columns]).max(1) < MAX_FLOW_PX)
        & (cycle_error_px[rows, columns] < MAX_CYCLE_ERROR_PX)
    )
    if good.sum() < MIN_PAIRS:
        return None
    points_map = rigid.apply(
        world_from_camera, cameras.unproject(start[good], intrinsics) * template_z[good, None]
    )
    count, sigma = int(good.sum()), SIGMA_PX / intrinsics[0, 0] * z[good]
    first, second = np.full(count, frame), np.full(count, MAP)
    axes = [np.broadcast_to(world_from_camera[:3, i], (count, 3)) for i in (0, 1)]
    return Correspondences.join(
        *(Correspondences(first, second, points_camera[good], points_map, axis, sigma) for axis in axes)
    )


def _flow(first, second):
    """Return optical flow and its forward-backward error, pixels."""
    dense = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    no_guess = np.zeros(0, np.float32)
    forward, backward = dense.calc(first, second, no_guess), dense.calc(second, first, no_guess)
    row, column = np.mgrid[: first.shape[0], : first.shape[1]].astype(np.float32)
    border = (OUTSIDE_PX, OUTSIDE_PX)
    returned = cv2.remap(
        backward, column + forward[..., 0], row + forward[..., 1], cv2.INTER_LINEAR, borderValue=border
    )
    return forward, np.linalg.norm(forward + returned, axis=-1)
