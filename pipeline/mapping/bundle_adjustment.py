"""Bundle adjustment with depth, as a term of `pose_optimization`.

`TrackedPoints` are pixels that show the same point, with the depth measured there; `chained` makes them of
matches. `PointTerm` fits points and lenses to given cameras and eliminates the points: normal equations of
the cameras remain (Triggs et al. 2000, section 6).
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
"""Deviation of a pixel that the first points assume, and the least: SIFT is no better."""
DEPTH_CORRELATION, MIN_DEPTH_INFLATION = 2.0, 2.0
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
RADIAL_SIGMA, MIN_BEND_PX = 0.05, 0.5
"""Deviation of a lens's radial distortion from none, and the distortion at its outermost point below which it
counts as none: what noise finds in a pinhole."""


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
    """Which lens saw it, from 0."""

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


def chained(
    pixels: Sequence[Float[np.ndarray, "_ 2"]],
    depths_m: Sequence[Float[np.ndarray, "_"]],
    intrinsics: Float[np.ndarray, "camera 3 3"],
    lens: Int[np.ndarray, "camera"],
    links: Sequence[tuple[int, int, Int[np.ndarray, "_ 2"]]],
) -> TrackedPoints:
    """Chain matches to points: each camera's keypoints with the depth under them (NaN: unknown), and pairs of
    cameras with the rows of their keypoints that match. What shows twice in a picture is no point.
    """
    starts = np.concatenate([[0], np.cumsum([len(each) for each in pixels])])
    linked = [found + starts[[first, second]] for first, second, found in links]
    first, second = np.concatenate([np.zeros((0, 2), int), *linked]).T
    graph = sparse.coo_array((np.ones(len(first)), (first, second)), shape=(starts[-1], starts[-1]))
    point = connected_components(graph, directed=False)[1]
    camera = np.repeat(np.arange(len(pixels)), np.diff(starts))
    _, place, met = np.unique(np.stack([point, camera]), axis=1, return_inverse=True, return_counts=True)
    twice = np.zeros(starts[-1] + 1, bool)
    twice[point[(met > 1)[place.ravel()]]] = True
    row = np.flatnonzero((np.bincount(point, minlength=1)[point] > 1) & ~twice[point])
    camera, pinhole = camera[row], intrinsics[camera[row]]
    pixel = np.concatenate([np.zeros((0, 2)), *pixels])[row]
    depth = np.concatenate([np.zeros(0), *depths_m])[row]
    focal, center, sigma = pinhole[:, [0, 1], [0, 1]], pinhole[:, :2, 2], depth_noise(np.nan_to_num(depth))
    point = np.unique(point[row], return_inverse=True)[1]
    return TrackedPoints(camera, point, pixel, focal, center, depth, sigma, lens[camera])


class PointTerm:
    """The squared, robust reprojection and depth errors of tracked points, minimized over the points."""

    def __init__(self, tracked: TrackedPoints, world_from_camera: Float[np.ndarray, "camera 4 4"]):
        """Begin with the points where depth and these cameras place them."""
        self.tracked, self.points_world = tracked, tracked.lifted(world_from_camera)
        self.sigma_px, self.depth_inflation = FIRST_SIGMA_PX, MIN_DEPTH_INFLATION
        self.radial = np.zeros(int(tracked.lens.max(initial=0)) + 1)
        """Per lens: what it shows r focal lengths from the centre belongs at r (1 + radial r^2)."""
        flat = (tracked.pixel - tracked.center_px) / tracked.focal_px
        self._bend_px = tracked.focal_px * flat * (flat**2).sum(1, keepdims=True)

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

    def _error_px(self, local):
        """Return how far from their straightened pixels points are seen."""
        t = self.tracked
        seen = local[:, :2] / np.maximum(local[:, 2:], NEAREST_M) * t.focal_px + t.center_px
        return seen - t.pixel - self.radial[t.lens, None] * self._bend_px

    def _measure(self, world_from_camera):
        t, local = self.tracked, self._local(world_from_camera)
        error_px = self._error_px(local)
        self.sigma_px = max(MIN_SIGMA_PX, MAD_TO_SIGMA * float(np.median(np.abs(error_px))))
        known = np.isfinite(t.depth_m)
        if known.any():
            error = np.abs(local[known, 2] - t.depth_m[known]) / t.depth_sigma_m[known]
            measured = DEPTH_CORRELATION * MAD_TO_SIGMA * float(np.median(error))
            self.depth_inflation = max(MIN_DEPTH_INFLATION, measured)

    def _linearized(self, world_from_camera):
        """Return weighted residuals [observation 3], their derivative by the point, and the local points."""
        t, local = self.tracked, self._local(world_from_camera)
        z = np.maximum(local[:, 2:], NEAREST_M)
        pixel = self._error_px(local) / self.sigma_px
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
        self._weight = weight
        return weight * np.column_stack([pixel, depth]), by_point, local

    def _hessian(self, by_point):
        product = np.einsum("oki,okj->oij", by_point, by_point)
        hessian = np.zeros((self.tracked.points, 3, 3))
        np.add.at(hessian, self.tracked.point, product)
        return hessian

    def _fit(self, world_from_camera):
        t, lenses = self.tracked, len(self.radial)
        own = np.eye(lenses)[t.lens]
        for _ in range(POINT_STEPS):
            residual, by_point, _ = self._linearized(world_from_camera)
            bend = -(self._weight[:, :2] * self._bend_px / self.sigma_px)[..., None] * own[:, None]
            gradient, cross = np.zeros((t.points, 3)), np.zeros((t.points, 3, lenses))
            np.add.at(gradient, t.point, np.einsum("oki,ok->oi", by_point, residual))
            np.add.at(cross, t.point, np.einsum("oki,okl->oil", by_point[:, :2], bend))
            inverse = np.linalg.inv(_damped(self._hessian(by_point)))
            pulled = inverse @ cross
            normal = np.einsum("okl,okm->lm", bend, bend) - np.einsum("pil,pim->lm", cross, pulled)
            slope = np.einsum("okl,ok->l", bend, residual[:, :2]) - np.einsum("pil,pi->l", pulled, gradient)
            prior = np.eye(lenses) / RADIAL_SIGMA**2
            step = np.linalg.solve(normal + prior, slope + prior @ self.radial)
            self.radial = self.radial - step
            self.points_world = self.points_world - np.einsum("pij,pj->pi", inverse, gradient - cross @ step)
        most = (np.abs(self.radial) * np.linalg.norm(self._bend_px, axis=1)[:, None] * own).max(0, initial=0)
        self.radial = np.where(most < MIN_BEND_PX, 0.0, self.radial)


def _damped(hessian):
    trace = np.trace(hessian, axis1=1, axis2=2)
    return hessian + (POINT_DAMPING * trace + 1e-9)[:, None, None] * np.eye(3)


def _blocks(values, index, shape):
    """Put one dense block per observation into a sparse matrix, at its camera's or point's columns."""
    count, height, width = values.shape
    row = np.broadcast_to(np.arange(count * height).reshape(count, height, 1), values.shape)
    column = np.broadcast_to((index[:, None, None] * width) + np.arange(width), values.shape)
    return sparse.csr_array((values.ravel(), (row.ravel(), column.ravel())), shape=shape)
