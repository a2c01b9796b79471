"""Whether depth is aligned with the pictures: depth steps lie on edges of pictures. This needs no poses.

Depth of a camera beside the color camera that was not registered to it is shifted by the parallax.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.geometry import rigid
from pipeline.mapping.edge_agreement import edge_contrast
from pipeline.mapping.picture_agreement import beats
from pipeline.recordings.recording import DepthCamera, reproject
from stages.check_captures.sampling import SampledFrame

SHIFTS_M, FOCAL_FACTORS = (-0.05, -0.025, 0.025, 0.05), (0.9, 1.1)
"""positions of the depth camera beside the color camera, and factors on its focal length, that are tried"""


def misalignment(shots: Sequence[SampledFrame]) -> str:
    """Return which other depth camera explains edges significantly better than the stored one; "" if none."""
    stored = _contrasts(shots)
    found = {}
    for x, y in [(shift, 0.0) for shift in SHIFTS_M] + [(0.0, shift) for shift in SHIFTS_M]:
        side = ("right" if x < 0 else "left") if x else ("below" if y < 0 else "above")
        found[f"is {100 * abs(x + y):g} cm {side} of the color camera"] = _contrasts(shots, (x, y, 0.0))
    for factor in FOCAL_FACTORS:
        found[f"has {factor:g} times the focal length"] = _contrasts(shots, focal=factor)
    better = {name: each for name, each in found.items() if beats(each, stored, tests=len(found))}
    return max(better, key=lambda name: float(np.nanmean(better[name])), default="")


def _contrasts(
    shots: Sequence[SampledFrame], shift_m: Sequence[float] = (0.0, 0.0, 0.0), focal: float = 1.0
) -> Float[np.ndarray, "shot"]:
    """Return `edge_contrast` of shots if the depth camera were shifted or had another focal length."""
    contrasts, depth_from_color = [], rigid.make(np.eye(3), np.array(shift_m))
    for shot in shots:
        lens = shot.depth_intrinsics.copy()
        lens[[0, 1], [0, 1]] *= focal
        depth = reproject(shot.depth, DepthCamera(lens, depth_from_color), shot.intrinsics, shot.gray.shape)
        gray = cv2.resize(shot.gray, depth.shape[::-1], interpolation=cv2.INTER_AREA)
        contrasts.append(edge_contrast(gray, depth))
    return np.array(contrasts)
