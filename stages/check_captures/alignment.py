"""Whether depth is aligned with the pictures: depth steps lie on edges of pictures. This needs no poses.

Depth of a camera beside the color camera that was not registered to it is shifted by the parallax.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from pipeline.geometry import rigid
from pipeline.mapping.edge_agreement import edge_contrast, relative_gradient
from pipeline.mapping.picture_agreement import beats
from pipeline.recordings.recording import DepthCamera, reproject
from stages.check_captures.sampling import SampledFrame

SHIFTS_M, FOCAL_FACTORS = (-0.05, -0.025, 0.025, 0.05), (0.9, 1.1)
"""positions of the depth camera beside the color camera, and factors on its focal length, that are tried"""


def misalignment(shots: Sequence[SampledFrame]) -> str:
    """Return which other depth camera explains edges significantly better than the stored one; "" if none."""
    readings = {"": (0.0, 0.0, 1.0)}
    for x, y in [(shift, 0.0) for shift in SHIFTS_M] + [(0.0, shift) for shift in SHIFTS_M]:
        side = ("right" if x < 0 else "left") if x else ("below" if y < 0 else "above")
        readings[f"is {100 * abs(x + y):g} cm {side} of the color camera"] = x, y, 1.0
    for factor in FOCAL_FACTORS:
        readings[f"has {factor:g} times the focal length"] = 0.0, 0.0, factor
    contrasts = np.array([_contrasts(shot, list(readings.values())) for shot in shots])
    stored, *others = contrasts.reshape(-1, len(readings)).T
    names = list(readings)[1:]
    better = {name: each for name, each in zip(names, others, strict=True) if beats(each, stored, len(names))}
    return max(better, key=lambda name: float(np.nanmean(better[name])), default="")


def _contrasts(shot: SampledFrame, readings: Sequence[tuple[float, float, float]]) -> list[float]:
    """Return `edge_contrast` by readings: x and y of the depth camera (meters), factor on its focal."""
    depths = []
    for x, y, focal in readings:
        lens = shot.depth_intrinsics.copy()
        lens[[0, 1], [0, 1]] *= focal
        camera = DepthCamera(lens, rigid.make(np.eye(3), np.array([x, y, 0.0])))
        depths.append(reproject(shot.depth, camera, shot.intrinsics, shot.gray.shape))
    gray = cv2.resize(shot.gray, depths[0].shape[::-1], interpolation=cv2.INTER_AREA)
    gradient = relative_gradient(gray)
    return [edge_contrast(gradient, depth) for depth in depths]
