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
"""Standard deviation of the flow, half-size pixels: neighbouring pixels err together by hundreds."""
RETURN_PX = 1.0
"""Flow there and back must return to within this, half-size pixels: on mirrors it does not."""
STRIDE_PX, MARGIN_PX = 9, 4
"""One pixel in so many, each way, takes part, away from the margin, half-size pixels."""
LONGEST_PX = 12
"""Longer flow is none, half-size pixels."""
DEPTH_FITS_M = 0.12
"""Measured depth at the end of the flow must agree with the template's at its start, metres."""
MIN_KNOWN, MIN_PAIRS = 0.1, 20
"""Share of the picture that must show template, and pairs that must remain."""
OUTSIDE_PX = 1e3
"""Flow of pixels outside the picture."""


def flow_correspondences(
    clip: Clip, masks: Masks, caster: RayCaster, frame: int, world_from_camera: Float[np.ndarray, "4 4"]
) -> Correspondences | None:
    """Match one frame with the template rendered from its pose; None where too little can be matched."""
    pair = compare(clip, masks, caster, frame, world_from_camera)
    known, intrinsics = pair.known, pair.intrinsics
    if known.mean() < MIN_KNOWN:
        return None
    flow, return_px = _flow(
        local_contrast_normalization(pair.rendered, known), local_contrast_normalization(pair.recorded, known)
    )
    inner = tuple(slice(MARGIN_PX, side - MARGIN_PX, STRIDE_PX) for side in known.shape)
    rows, columns = np.mgrid[inner].reshape(2, -1)
    start = np.stack([columns, rows], axis=-1) + 0.5
    ray = cameras.unproject(start + flow[rows, columns], intrinsics)
    z = cameras.read_depth(clip.depth(frame), clip.depth_intrinsics[frame], ray)
    template_z = pair.depth[rows, columns]
    good = (
        known[rows, columns]
        & (z > 0)
        & (np.abs(z - template_z) < DEPTH_FITS_M)
        & (np.abs(flow[rows, columns]).max(1) < LONGEST_PX)
        & (return_px[rows, columns] < RETURN_PX)
    )
    if good.sum() < MIN_PAIRS:
        return None
    points_map = rigid.apply(
        world_from_camera, cameras.unproject(start[good], intrinsics) * template_z[good, None]
    )
    points_camera = ray[good] * z[good, None]
    count, sigma = int(good.sum()), SIGMA_PX / intrinsics[0, 0] * z[good]
    first, second = np.full(count, frame), np.full(count, MAP)
    sides = [np.broadcast_to(world_from_camera[:3, axis], (count, 3)) for axis in (0, 1)]
    return Correspondences.join(
        *(Correspondences(first, second, points_camera, points_map, side, sigma) for side in sides)
    )


def _flow(first, second):
    """Return optical flow and how far from its start it ends there and back, pixels."""
    dense = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    no_guess = np.zeros(0, np.float32)
    forward, backward = dense.calc(first, second, no_guess), dense.calc(second, first, no_guess)
    row, column = np.mgrid[: first.shape[0], : first.shape[1]].astype(np.float32)
    border = (OUTSIDE_PX, OUTSIDE_PX)
    returned = cv2.remap(
        backward, column + forward[..., 0], row + forward[..., 1], cv2.INTER_LINEAR, borderValue=border
    )
    return forward, np.linalg.norm(forward + returned, axis=-1)
