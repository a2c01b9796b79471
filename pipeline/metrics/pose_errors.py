"""Rigid alignment of true poses to ours, and the remaining pose errors."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry import rigid

OUTLIER_FACTOR = 4.0


def constant_between(
    ours: Float[np.ndarray, "frame 4 4"], truth: Float[np.ndarray, "frame 4 4"]
) -> Float[np.ndarray, "4 4"]:
    """Fit ``ours_from_truth`` such that ``ours = ours_from_truth @ truth`` over all frames; no scale.

    Frames far beyond the median residual are excluded from a second fit; NaN poses are ignored.
    """
    known = np.isfinite(ours).all((1, 2)) & np.isfinite(truth).all((1, 2))
    ours, truth = ours[known], truth[known]
    assert len(ours) >= 3, len(ours)
    keep = np.ones(len(ours), bool)
    for _ in range(2):
        each = ours[keep] @ rigid.inverse(truth[keep])
        rotation = rigid.mean_rotation(each[:, :3, :3])
        shift = ours[keep, :3, 3] - truth[keep, :3, 3] @ rotation.T
        ours_from_truth = rigid.make(rotation, np.median(shift, axis=0))
        left = pose_errors(ours, ours_from_truth @ truth)
        keep = left.meters <= OUTLIER_FACTOR * max(np.median(left.meters), 1e-6)
    return ours_from_truth


@dataclass(frozen=True)
class PoseErrors:
    """Errors per frame; infinite where we have no pose."""

    degrees: Float[np.ndarray, "frame"]
    meters: Float[np.ndarray, "frame"]

    def __getitem__(self, keep: Bool[np.ndarray, "frame"]) -> "PoseErrors":
        """Return some of the frames."""
        return PoseErrors(self.degrees[keep], self.meters[keep])


def pose_errors(ours: Float[np.ndarray, "frame 4 4"], truth: Float[np.ndarray, "frame 4 4"]) -> PoseErrors:
    """Return geodesic angles and distances of the origins between poses in one frame of reference."""
    known = np.isfinite(ours).all((1, 2))
    degrees, meters = np.full(len(ours), np.inf), np.full(len(ours), np.inf)
    degrees[known] = np.degrees(rigid.rotation_angle(ours[known, :3, :3], truth[known, :3, :3]))
    meters[known] = np.linalg.norm(ours[known, :3, 3] - truth[known, :3, 3], axis=1)
    return PoseErrors(degrees, meters)


def joined(errors: list[PoseErrors]) -> PoseErrors:
    """Concatenate the errors of several videos."""
    empty = [PoseErrors(np.zeros(0), np.zeros(0))]
    return PoseErrors(
        *(np.concatenate([getattr(each, name) for each in errors or empty]) for name in ("degrees", "meters"))
    )
