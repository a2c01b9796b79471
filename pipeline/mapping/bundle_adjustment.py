"""Bundle adjustment with depth, as a term of `pose_optimization`.

`build_tracks` chains matches to `TrackedPoints`: observations of shared points with measured depth.
`PointTerm` refines points and radial distortion for given cameras and eliminates the points by the Schur
complement, which leaves normal equations of the cameras (Triggs et al. 2000, section 6).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from pipeline.mapping.depth_scans import depth_noise

ROBUST_SIGMAS = 3.0
"""Width of the robust weight, standard deviations."""
FIRST_SIGMA_PX, MIN_SIGMA_PX = 1.0, 0.3
"""Initial and least standard deviation of a keypoint, pixels: SIFT is no better."""
DEPTH_CORRELATION, MIN_DEPTH_INFLATION = 2.0, 2.0
"""Depth errors correlate across a picture: factor on their measured standard deviation, and its least ratio
to the assumed one."""
MAD_TO_SIGMA = 1.4826
"""Ratio of standard deviation to median absolute deviation of a normal distribution."""
POINT_STEPS = 3
"""Gauss-Newton steps of the points per call; they start from the previous call's points."""
POINT_DAMPING = 1e-6
"""Damping of a point's step, relative to its Hessian's trace: keeps points on parallel rays solvable."""
MIN_DEPTH_M = 0.05
"""Observations of nearer points are ignored, meters."""
RADIAL_SIGMA, MIN_DISTORTION_PX = 0.05, 0.5
"""Prior standard deviation of radial distortion, and the largest distortion (pixels) that is set to zero
as noise."""


@dataclass(frozen=True)
class TrackedPoints:
    """Observations of points by cameras."""

    camera: Int[np.ndarray, "observation"]
    point: Int[np.ndarray, "observation"]
    pixel: Float[np.ndarray, "observation 2"]
    focal_px: Float[np.ndarray, "observation 2"]
    center_px: Float[np.ndarray, "observation 2"]
    depth_m: Float[np.ndarray, "observation"]
    """Measured depth, NaN where there is none."""
    depth_sigma_m: Float[np.ndarray, "observation"]
    lens: Int[np.ndarray, "observation"]
    """Index of the lens, from 0."""

    @property
    def points(self) -> int:
        """The number of points."""
        return int(self.point.max()) + 1 if len(self.point) else 0

    def covisibility(self, cameras: int) -> Int[np.ndarray, "camera camera"]:
        """Return the number of points that each pair of cameras shares."""
        ones = np.ones(len(self.camera), int)
        seen = sparse.csr_array((ones, (self.camera, self.point)), shape=(cameras, self.points))
        return (seen @ seen.T).toarray()

    def unproject(self, world_from_camera: Float[np.ndarray, "camera 4 4"]) -> Float[np.ndarray, "point 3"]:
        """Return each point's mean back-projected position, world frame; zero without depth."""
        valid = np.isfinite(self.depth_m)
        ray = np.concatenate(
            [(self.pixel - self.center_px) / self.focal_px, np.ones((len(self.pixel), 1))], 1
        )
        pose = world_from_camera[self.camera[valid]]
        world = np.einsum("oij,oj->oi", pose[:, :3, :3], ray[valid] * self.depth_m[valid, None])
        total, count = np.zeros((self.points, 3)), np.bincount(self.point[valid], minlength=self.points)
        np.add.at(total, self.point[valid], world + pose[:, :3, 3])
        return total / np.maximum(count, 1)[:, None]


def build_tracks(
    pixels: Sequence[Float[np.ndarray, "_ 2"]],
    depths_m: Sequence[Float[np.ndarray, "_"]],
    intrinsics: Float[np.ndarray, "camera 3 3"],
    lens: Int[np.ndarray, "camera"],
    links: Sequence[tuple[int, int, Int[np.ndarray, "_ 2"]]],
) -> TrackedPoints:
    """Chain pairwise matches to tracks; tracks with two keypoints in one picture are dropped.

    ``depths_m`` is the depth at each keypoint (NaN: unknown); ``links`` are camera pairs with matched rows.
    """
    starts = np.concatenate([[0], np.cumsum([len(each) for each in pixels])])
    linked = [found + starts[[first, second]] for first, second, found in links]
    first, second = np.concatenate([np.zeros((0, 2), int), *linked]).T
    graph = sparse.coo_array((np.ones(len(first)), (first, second)), shape=(starts[-1], starts[-1]))
    point = connected_components(graph, directed=False)[1]
    camera = np.repeat(np.arange(len(pixels)), np.diff(starts))
    _, group, counts = np.unique(np.stack([point, camera]), axis=1, return_inverse=True, return_counts=True)
    ambiguous = np.zeros(starts[-1] + 1, bool)
    ambiguous[point[(counts > 1)[group.ravel()]]] = True
    valid_rows = np.flatnonzero((np.bincount(point, minlength=1)[point] > 1) & ~ambiguous[point])
    camera, pinhole = camera[valid_rows], intrinsics[camera[valid_rows]]
    pixel = np.concatenate([np.zeros((0, 2)), *pixels])[valid_rows]
    depth = np.concatenate([np.zeros(0), *depths_m])[valid_rows]
    focal, center, sigma = pinhole[:, [0, 1], [0, 1]], pinhole[:, :2, 2], depth_noise(np.nan_to_num(depth))
    point = np.unique(point[valid_rows], return_inverse=True)[1]
    return TrackedPoints(camera, point, pixel, focal, center, depth, sigma, lens[camera])


class PointTerm:
    """Robust reprojection and depth errors of tracked points, minimized over the points."""

    def __init__(self, tracked: TrackedPoints, world_from_camera: Float[np.ndarray, "camera 4 4"]):
        """Initialize the points by back-projected depth."""
        self.tracked, self.points_world = tracked, tracked.unproject(world_from_camera)
        self.sigma_px, self.depth_inflation = FIRST_SIGMA_PX, MIN_DEPTH_INFLATION
        self.radial = np.zeros(int(tracked.lens.max(initial=0)) + 1)
        """Per lens: a pixel at radius r (in focal lengths) is undistorted to r (1 + radial r^2)."""
        ray = (tracked.pixel - tracked.center_px) / tracked.focal_px
        self._distortion_px = tracked.focal_px * ray * (ray**2).sum(1, keepdims=True)

    def normal_equations(
        self, world_from_camera: Float[np.ndarray, "camera 4 4"]
    ) -> tuple[sparse.csc_array, Float[np.ndarray, "parameter"]]:
        """Return matrix and gradient for the cameras' right-hand twists after eliminating the points.

        Noise levels of pixels and depth are first estimated from the median residuals.
        """
        self._update_points(world_from_camera)
        self._estimate_noise(world_from_camera)
        residual, by_point, local = self._linearize(world_from_camera)
        t, rows = self.tracked, len(self.tracked.camera)
        rotation = world_from_camera[t.camera, :3, :3]
        # A camera's twist (w, v) moves a point in the camera frame by local x w - v.
        by_local = by_point @ rotation
        by_camera = np.concatenate([np.cross(by_local, local[:, None]), -by_local], axis=2)
        shape = (3 * rows, 6 * len(world_from_camera))
        jacobian = _block_matrix(by_camera, t.camera, shape)
        points = _block_matrix(by_point, t.point, (3 * rows, 3 * t.points))
        inverse = np.linalg.inv(_damped(self._hessian(by_point)))
        block = np.arange(t.points)
        eliminated = sparse.bsr_array(
            (inverse, block, np.arange(t.points + 1)), shape=(3 * t.points, 3 * t.points)
        ).tocsr()
        cross = (jacobian.T @ points).tocsr()
        normal = jacobian.T @ jacobian - cross @ eliminated @ cross.T
        flat = residual.ravel()
        gradient = jacobian.T @ flat - cross @ (eliminated @ (points.T @ flat))
        return normal.tocsc(), gradient

    def _to_camera(self, world_from_camera):
        pose = world_from_camera[self.tracked.camera]
        moved = self.points_world[self.tracked.point] - pose[:, :3, 3]
        return np.einsum("oji,oj->oi", pose[:, :3, :3], moved)

    def _reprojection_error(self, local):
        """Return reprojection errors of undistorted pixels."""
        t = self.tracked
        seen = local[:, :2] / np.maximum(local[:, 2:], MIN_DEPTH_M) * t.focal_px + t.center_px
        return seen - t.pixel - self.radial[t.lens, None] * self._distortion_px

    def _estimate_noise(self, world_from_camera):
        t, local = self.tracked, self._to_camera(world_from_camera)
        error_px = self._reprojection_error(local)
        self.sigma_px = max(MIN_SIGMA_PX, MAD_TO_SIGMA * float(np.median(np.abs(error_px))))
        valid = np.isfinite(t.depth_m)
        if valid.any():
            error = np.abs(local[valid, 2] - t.depth_m[valid]) / t.depth_sigma_m[valid]
            measured = DEPTH_CORRELATION * MAD_TO_SIGMA * float(np.median(error))
            self.depth_inflation = max(MIN_DEPTH_INFLATION, measured)

    def _linearize(self, world_from_camera):
        """Return weighted residuals [observation 3], their Jacobian by the point, and camera-frame points."""
        t, local = self.tracked, self._to_camera(world_from_camera)
        z = np.maximum(local[:, 2:], MIN_DEPTH_M)
        pixel = self._reprojection_error(local) / self.sigma_px
        valid = np.isfinite(t.depth_m)
        depth = np.where(valid, local[:, 2] - np.nan_to_num(t.depth_m), 0.0)
        depth = depth / (self.depth_inflation * t.depth_sigma_m)
        width = ROBUST_SIGMAS**2
        in_front = local[:, 2] > MIN_DEPTH_M
        weight = np.stack(
            [in_front * width / (width + (pixel**2).sum(1)), valid * width / (width + depth**2)], axis=1
        )
        projection = np.zeros((len(local), 3, 3))
        scale = t.focal_px / z / self.sigma_px
        projection[:, 0, 0], projection[:, 1, 1] = scale[:, 0], scale[:, 1]
        projection[:, :2, 2] = -scale * local[:, :2] / z
        projection[:, 2, 2] = 1 / (self.depth_inflation * t.depth_sigma_m)
        weight = weight[:, [0, 0, 1]]
        camera_from_world = np.swapaxes(world_from_camera[t.camera, :3, :3], 1, 2)
        by_point = weight[..., None] * (projection @ camera_from_world)
        self._weight = weight
        return weight * np.column_stack([pixel, depth]), by_point, local

    def _hessian(self, by_point):
        product = np.einsum("oki,okj->oij", by_point, by_point)
        hessian = np.zeros((self.tracked.points, 3, 3))
        np.add.at(hessian, self.tracked.point, product)
        return hessian

    def _update_points(self, world_from_camera):
        t, lenses = self.tracked, len(self.radial)
        one_hot = np.eye(lenses)[t.lens]
        for _ in range(POINT_STEPS):
            residual, by_point, _ = self._linearize(world_from_camera)
            weighted_px = self._weight[:, :2] * self._distortion_px / self.sigma_px
            d_radial = -weighted_px[..., None] * one_hot[:, None]
            gradient, cross = np.zeros((t.points, 3)), np.zeros((t.points, 3, lenses))
            np.add.at(gradient, t.point, np.einsum("oki,ok->oi", by_point, residual))
            np.add.at(cross, t.point, np.einsum("oki,okl->oil", by_point[:, :2], d_radial))
            inverse = np.linalg.inv(_damped(self._hessian(by_point)))
            eliminated = inverse @ cross
            normal = np.einsum("okl,okm->lm", d_radial, d_radial)
            normal = normal - np.einsum("pil,pim->lm", cross, eliminated)
            g_radial = np.einsum("okl,ok->l", d_radial, residual[:, :2])
            g_radial = g_radial - np.einsum("pil,pi->l", eliminated, gradient)
            prior = np.eye(lenses) / RADIAL_SIGMA**2
            step = np.linalg.solve(normal + prior, g_radial + prior @ self.radial)
            self.radial = self.radial - step
            self.points_world = self.points_world - np.einsum("pij,pj->pi", inverse, gradient - cross @ step)
        distortion_px = np.linalg.norm(self._distortion_px, axis=1)[:, None]
        max_px = (np.abs(self.radial) * distortion_px * one_hot).max(0, initial=0)
        self.radial = np.where(max_px < MIN_DISTORTION_PX, 0.0, self.radial)


def _damped(hessian):
    trace = np.trace(hessian, axis1=1, axis2=2)
    return hessian + (POINT_DAMPING * trace + 1e-9)[:, None, None] * np.eye(3)


def _block_matrix(values, index, shape):
    """Return the sparse matrix of one dense block per observation, at the columns of its camera or point."""
    count, height, width = values.shape
    row = np.broadcast_to(np.arange(count * height).reshape(count, height, 1), values.shape)
    column = np.broadcast_to((index[:, None, None] * width) + np.arange(width), values.shape)
    return sparse.csr_array((values.ravel(), (row.ravel(), column.ravel())), shape=shape)
