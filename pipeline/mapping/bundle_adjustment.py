"""Bundle adjustment with depth, as a term of `pose_optimization`.

`TrackedPoints` are pixels that show the same point, with the depth measured there. `PointTerm` fits points to
given cameras and eliminates them: normal equations of the cameras remain (Triggs et al. 2000, section 6).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

ROBUST_SIGMAS = 3.0
"""Width of the robust weight, standard deviations."""
FIRST_SIGMA_PX, LEAST_SIGMA_PX = 1.0, 0.3
"""Deviation of a pixel that the first points assume, and the least: SIFT is no better."""
DEPTH_CORRELATION, LEAST_DEPTH_INFLATION = 2.0, 2.0
"""Depth errs together over a picture: its deviation counts so many times, and is at least so many times the
assumed one."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
POINT_STEPS = 3
"""Gauss-Newton steps of the points per call; they are warm."""
POINT_DAMPING = 1e-6
"""Damping of a point's step, share of its matrix's trace: points that parallel rays see stay solvable."""
NEAREST_M = 0.05
"""Observations of points nearer than this do not count, metres."""


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

    @property
    def points(self) -> int:
        """The number of points."""
        return int(self.point.max()) + 1 if len(self.point) else 0

    def shared(self, cameras: int) -> Int[np.ndarray, "camera camera"]:
        """Return how many points each pair of cameras shares."""
        ones = np.ones(len(self.camera), int)
        seen = sparse.csr_array((ones, (self.camera, self.point)), shape=(cameras, self.points))
        return (seen @ seen.T).toarray()

    def lifted(self, world_from_camera: Float[np.ndarray, "camera 4 4"]) -> Float[np.ndarray, "point 3"]:
        """Return the mean of each point's measured positions, world; zero for points that none measured."""
        known = np.isfinite(self.depth_m)
        ray = np.concatenate(
            [(self.pixel - self.center_px) / self.focal_px, np.ones((len(self.pixel), 1))], 1
        )
        pose = world_from_camera[self.camera[known]]
        world = np.einsum("oij,oj->oi", pose[:, :3, :3], ray[known] * self.depth_m[known, None])
        total, count = np.zeros((self.points, 3)), np.bincount(self.point[known], minlength=self.points)
        np.add.at(total, self.point[known], world + pose[:, :3, 3])
        return total / np.maximum(count, 1)[:, None]


class PointTerm:
    """The squared, robust reprojection and depth errors of tracked points, minimized over the points."""

    def __init__(self, tracked: TrackedPoints, world_from_camera: Float[np.ndarray, "camera 4 4"]):
        """Begin with the points where depth and these cameras place them."""
        self.tracked, self.points_world = tracked, tracked.lifted(world_from_camera)
        self.sigma_px, self.depth_inflation = FIRST_SIGMA_PX, LEAST_DEPTH_INFLATION

    def normal_equations(
        self, world_from_camera: Float[np.ndarray, "camera 4 4"]
    ) -> tuple[sparse.csc_array, Float[np.ndarray, "parameter"]]:
        """Return matrix and gradient for the cameras' right-hand twists after eliminating the points.

        Deviations of pixels and depth are measured first, robustly.
        """
        self._fit(world_from_camera)
        self._measure(world_from_camera)
        residual, by_point, local = self._linearized(world_from_camera)
        t, rows = self.tracked, len(self.tracked.camera)
        rotation = world_from_camera[t.camera, :3, :3]
        # A camera's twist (w, v) moves the point in its axes by local x w - v, the world's point by rotation.
        by_local = by_point @ rotation
        by_camera = np.concatenate([np.cross(by_local, local[:, None]), -by_local], axis=2)
        shape = (3 * rows, 6 * len(world_from_camera))
        jacobian = _blocks(by_camera, t.camera, shape)
        points = _blocks(by_point, t.point, (3 * rows, 3 * t.points))
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

    def _local(self, world_from_camera):
        pose = world_from_camera[self.tracked.camera]
        moved = self.points_world[self.tracked.point] - pose[:, :3, 3]
        return np.einsum("oji,oj->oi", pose[:, :3, :3], moved)

    def _measure(self, world_from_camera):
        t, local = self.tracked, self._local(world_from_camera)
        error_px = local[:, :2] / np.maximum(local[:, 2:], NEAREST_M) * t.focal_px + t.center_px - t.pixel
        self.sigma_px = max(LEAST_SIGMA_PX, MAD_TO_SIGMA * float(np.median(np.abs(error_px))))
        known = np.isfinite(t.depth_m)
        if known.any():
            error = np.abs(local[known, 2] - t.depth_m[known]) / t.depth_sigma_m[known]
            measured = DEPTH_CORRELATION * MAD_TO_SIGMA * float(np.median(error))
            self.depth_inflation = max(LEAST_DEPTH_INFLATION, measured)

    def _linearized(self, world_from_camera):
        """Return weighted residuals [observation 3], their derivative by the point, and the local points."""
        t, local = self.tracked, self._local(world_from_camera)
        z = np.maximum(local[:, 2:], NEAREST_M)
        pixel = (local[:, :2] / z * t.focal_px + t.center_px - t.pixel) / self.sigma_px
        known = np.isfinite(t.depth_m)
        depth = np.where(known, local[:, 2] - np.nan_to_num(t.depth_m), 0.0)
        depth = depth / (self.depth_inflation * t.depth_sigma_m)
        width = ROBUST_SIGMAS**2
        in_front = local[:, 2] > NEAREST_M
        weight = np.stack(
            [in_front * width / (width + (pixel**2).sum(1)), known * width / (width + depth**2)], axis=1
        )
        projection = np.zeros((len(local), 3, 3))
        scale = t.focal_px / z / self.sigma_px
        projection[:, 0, 0], projection[:, 1, 1] = scale[:, 0], scale[:, 1]
        projection[:, :2, 2] = -scale * local[:, :2] / z
        projection[:, 2, 2] = 1 / (self.depth_inflation * t.depth_sigma_m)
        weight = weight[:, [0, 0, 1]]
        camera_from_world = np.swapaxes(world_from_camera[t.camera, :3, :3], 1, 2)
        by_point = weight[..., None] * (projection @ camera_from_world)
        return weight * np.column_stack([pixel, depth]), by_point, local

    def _hessian(self, by_point):
        product = np.einsum("oki,okj->oij", by_point, by_point)
        hessian = np.zeros((self.tracked.points, 3, 3))
        np.add.at(hessian, self.tracked.point, product)
        return hessian

    def _fit(self, world_from_camera):
        for _ in range(POINT_STEPS):
            residual, by_point, _ = self._linearized(world_from_camera)
            gradient = np.zeros((self.tracked.points, 3))
            np.add.at(gradient, self.tracked.point, np.einsum("oki,ok->oi", by_point, residual))
            step = np.linalg.solve(_damped(self._hessian(by_point)), gradient[..., None])[..., 0]
            self.points_world = self.points_world - step


def _damped(hessian):
    trace = np.trace(hessian, axis1=1, axis2=2)
    return hessian + (POINT_DAMPING * trace + 1e-9)[:, None, None] * np.eye(3)


def _blocks(values, index, shape):
    """Put one dense block per observation into a sparse matrix, at its camera's or point's columns."""
    count, height, width = values.shape
    row = np.broadcast_to(np.arange(count * height).reshape(count, height, 1), values.shape)
    column = np.broadcast_to((index[:, None, None] * width) + np.arange(width), values.shape)
    return sparse.csr_array((values.ravel(), (row.ravel(), column.ravel())), shape=shape)
