"""Calibration of a plain video: focal length and radial distortion, from correspondences with the map."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap
import scipy.optimize
import scipy.sparse
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from pipeline.geometry import rigid
from stages.estimate_depth.landmarks import Matches

FOCAL_SHARE = 0.85
"""Initial focal length, share of the picture's longer side: a phone's main camera."""
FRAMES = 40
"""Frames used for calibration: those with most matches."""
MIN_MATCHES = 6
"""Least matches for a pose: with fewer, three wrong ones may agree."""
MIN_INLIERS, MIN_SHARE = 25, 0.25
"""Inliers and inlier ratio of a reliable pose."""
INLIER_SHARE = 0.008
"""RANSAC threshold, share of the picture's longer side: map points are accurate to centimeters."""
MAX_EVALUATIONS = 30
"""Largest number of residual evaluations."""
LOSS_PX = 1.0
"""Scale of the robust loss, pixels."""
RADIAL_SIGMA = 0.05
"""Prior standard deviation of the radial coefficient: phones undistort their videos."""
MIN_DISTORTION_PX = 0.5
"""Corner displacement below which distortion is ignored, pixels."""


@dataclass(frozen=True)
class Lens:
    """A centered pinhole camera with the first radial distortion coefficient (COLMAP's k1)."""

    focal_px: float
    radial: float
    size: tuple[int, int]
    """(height, width) of the pictures."""

    def resized(self, size: tuple[int, int]) -> "Lens":
        """Return the lens of undistorted pictures of another (height, width)."""
        return Lens(self.focal_px * size[1] / self.size[1], 0.0, size)

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """Return the pinhole matrix."""
        height, width = self.size
        return np.array([[self.focal_px, 0, width / 2], [0, self.focal_px, height / 2], [0, 0, 1]])

    @property
    def is_distorted(self) -> bool:
        """Return whether pictures must be undistorted."""
        corner = np.hypot(*self.size) / 2 / self.focal_px
        return abs(self.radial) * corner**3 * self.focal_px > MIN_DISTORTION_PX

    def project(self, points_camera: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 2"]:
        """Project points in front of the camera to pixels."""
        flat = points_camera[:, :2] / np.maximum(points_camera[:, 2:], 1e-3)
        distorted = flat * (1 + self.radial * (flat**2).sum(1, keepdims=True))
        return self.focal_px * distorted + np.array(self.size[::-1]) / 2

    def undistorted(self, color: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
        """Undistort a picture."""
        if not self.is_distorted:
            return color
        centered = self.intrinsics
        centered[:2, 2] -= 0.5
        return cv2.undistort(color, centered, np.array([self.radial, 0, 0, 0]))


@dataclass(frozen=True)
class PnPResult:
    """One frame's camera pose and its inliers."""

    world_from_camera: Float[np.ndarray, "4 4"]
    matches: Matches
    """The inliers."""
    inlier_ratio: float
    """Of all matches."""
    focal_px: float

    @property
    def reliable(self) -> bool:
        """Return whether the inliers suffice to trust the pose without neighbors."""
        return len(self.matches.pixel) >= MIN_INLIERS and self.inlier_ratio >= MIN_SHARE


def nominal(size: tuple[int, int]) -> Lens:
    """Return the lens to start from for pictures of (height, width)."""
    return Lens(FOCAL_SHARE * max(size), 0.0, size)


def locate(
    matches: Matches, lens: Lens, seed: int, *, within_px: float | None = None, calibrate: bool = False
) -> PnPResult | None:
    """Estimate a frame's camera by PnP with LO-RANSAC and refinement; ``calibrate``: its focal length too.

    None without enough matches or a consensus.
    """
    if len(matches.pixel) < MIN_MATCHES:
        return None
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    estimation.ransac.random_seed = seed
    estimation.ransac.max_error = within_px or INLIER_SHARE * max(lens.size)
    estimation.estimate_focal_length = refinement.refine_focal_length = calibrate
    height, width = lens.size
    parameters = [lens.focal_px, width / 2, height / 2, lens.radial]
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=parameters)
    found = pycolmap.estimate_and_refine_absolute_pose(
        matches.pixel, matches.points_world, camera, estimation, refinement
    )
    if found is None:
        return None
    inlier = np.asarray(found["inlier_mask"], bool)
    camera_from_world = np.eye(4)
    camera_from_world[:3] = found["cam_from_world"].matrix()
    agreeing = Matches(matches.pixel[inlier], matches.points_world[inlier])
    return PnPResult(rigid.inverse(camera_from_world), agreeing, float(inlier.mean()), camera.focal_length)


def locate_all(matches: Sequence[Matches], lens: Lens, seed: int) -> Float[np.ndarray, "frame 4 4"]:
    """Return the reliable poses of frames one by one, NaN for the others."""
    found = [locate(each, lens, seed) for each in matches]
    unknown = np.full((4, 4), np.nan)
    return np.stack([each.world_from_camera if each and each.reliable else unknown for each in found])


def calibrate(matches: Sequence[Matches], size: tuple[int, int], seed: int) -> Lens | None:
    """Calibrate the lens over all frames; None if no frame has a reliable pose."""
    most = np.argsort([-len(each.pixel) for each in matches], kind="stable")[:FRAMES]
    free = [locate(matches[frame], nominal(size), seed, calibrate=True) for frame in most]
    focal = [(each.focal_px, len(each.matches.pixel)) for each in filter(None, free) if each.reliable]
    if not focal:
        return None
    px, weight = np.array(sorted(focal)).T
    first = Lens(float(px[np.searchsorted(np.cumsum(weight), 0.5 * weight.sum())]), 0.0, size)
    located = [locate(matches[frame], first, seed) for frame in most]
    reliable = [each for each in filter(None, located) if each.reliable]
    return bundle_adjust(first, reliable) if reliable else first


def bundle_adjust(lens: Lens, located: Sequence[PnPResult], *, distortion: bool = True) -> Lens:
    """Jointly refine focal length, cameras and, if asked, ``distortion`` on fixed map points."""
    camera_from_world = np.stack([rigid.inverse(each.world_from_camera) for each in located])
    count = [len(each.matches.pixel) for each in located]
    frame = np.repeat(np.arange(len(located)), count)
    pixel = np.concatenate([each.matches.pixel for each in located])
    points = np.concatenate([each.matches.points_world for each in located])

    def residuals(values):
        (scale, radial), twist = values[:2], values[2:].reshape(-1, 6)
        rotation = Rotation.from_rotvec(twist[:, :3]).as_matrix() @ camera_from_world[:, :3, :3]
        moved = np.einsum("mij,mj->mi", rotation[frame], points)
        moved += (camera_from_world[:, :3, 3] + twist[:, 3:])[frame]
        off_px = (Lens(scale * lens.focal_px, radial, lens.size).project(moved) - pixel).ravel()
        sigma = RADIAL_SIGMA if distortion else 1e-6
        return np.append(off_px, (radial - lens.radial) * np.sqrt(len(pixel)) / sigma)

    sparsity = scipy.sparse.lil_matrix((2 * len(pixel) + 1, 2 + 6 * len(located)), dtype=int)
    sparsity[:, :2] = 1
    for number, own in enumerate(np.split(np.arange(2 * len(pixel)), 2 * np.cumsum(count)[:-1])):
        sparsity[own[0] : own[-1] + 1, 2 + 6 * number : 8 + 6 * number] = 1
    start = np.r_[1.0, lens.radial, np.zeros(6 * len(located))]
    fitted = scipy.optimize.least_squares(
        residuals,
        start,
        jac_sparsity=sparsity,
        loss="soft_l1",
        f_scale=LOSS_PX,
        x_scale="jac",
        max_nfev=MAX_EVALUATIONS,
    )
    return Lens(float(fitted.x[0] * lens.focal_px), float(fitted.x[1]), lens.size)
