"""Find an animal that keeps still while the phone circles it, where the optical axes meet.

The optical axes meet near the animal; the level surface beneath that point is its ground; the connected
cluster of points above that ground nearest to the axes' meeting point is the animal.
"""

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float

from pipeline.core.errors import InputError
from pipeline.data.clips import Clip
from pipeline.geometry import rigid, subsampling
from pipeline.geometry.flying_pixels import supported
from pipeline.geometry.ground import GroundPlane, fit_ground
from pipeline.mapping.icp import depth_image
from stages.segment_agent.evidence import UNKNOWN, Evidence, EvidenceOf
from stages.segment_agent.refine import Edges
from stages.segment_agent.windows import Sphere, Window

MIN_AXIS_SPREAD = 1e-3
"""least mean squared sine of the angles between the optical axes and their common direction"""
FRAMES = 40
"""frames used for the cluster"""
REACH_M = 0.9
"""largest distance of the animal's parts from the focus of the optical axes"""
VOXEL_M = 0.025
"""edge of the cluster's voxels"""
CLEARANCE_M = 0.03
"""height above which points are certainly not ground"""
FOOT_M, FOOT_SPREAD_M = 0.008, 0.004
"""height above ground at even log-odds between ground and paw, and height per unit of log-odds"""
MIN_HITS = 3
"""minimum points per voxel"""
EDGES = Edges(radius_px=2, unsure=0.4)
"""voxels are coarser than evidence of motion"""
MARGIN_M, AXIS_OUTLIER_M = 0.05, 0.15
"""margin around the voxels, and of the ground above the focus; distance of an optical axis from the focus at
which its robust weight is a half"""
MIN_UP, SURE = 0.9, 3.0
"""least upward component of a level surface's normal; limit of log-odds"""
MIN_GROUND_POINTS = 200
"""minimum points of level surface below the focus for a ground plane"""
NEAREST_M = 0.25
"""least median distance of the focus in front of the cameras"""


@dataclass(frozen=True)
class Cluster:
    """The voxels that the animal occupies, in the recording's world."""

    cells: Bool[np.ndarray, "x y z"]
    origin: Float[np.ndarray, "3"]

    def contains(self, points_world: Float[np.ndarray, "*shape 3"]) -> Bool[np.ndarray, "*shape"]:
        """Return which points lie in occupied voxels; NaN does not."""
        at = np.floor(np.nan_to_num((points_world - self.origin) / VOXEL_M, nan=-1.0)).astype(int)
        inside = ((at >= 0) & (at < self.cells.shape)).all(-1)
        at = np.clip(at, 0, np.array(self.cells.shape) - 1)
        return inside & self.cells[at[..., 0], at[..., 1], at[..., 2]]

    @property
    def sphere(self) -> Sphere:
        """Return a bounding sphere of the voxels."""
        centers = self.origin + (np.argwhere(self.cells) + 0.5) * VOXEL_M
        middle = (centers.min(0) + centers.max(0)) / 2
        return Sphere(middle, float(np.linalg.norm(centers - middle, axis=1).max() + MARGIN_M))


def find_standing(
    clip: Clip, world_from_camera: Float[np.ndarray, "frame 4 4"], focus: Float[np.ndarray, "3"] | None
) -> tuple[list[Sphere | None], EvidenceOf]:
    """Locate what stands at the focus; return a sphere per frame and its evidence. World: +y up.

    Raises InputError MSK-003 without a focus, a ground, or anything that stands on it there.
    """

    def refused(what: str) -> InputError:
        remedy = "circle the resting animal, with the ground in view, or (one animal) give a prompt"
        return InputError("MSK-003", what, str(clip.folder), remedy)

    if focus is None:
        raise refused("the cameras do not look at one place from around it")
    points, ground = surroundings(clip, world_from_camera, focus)
    if ground is None:
        raise refused("no level ground is seen where the cameras look")
    cluster = find_cluster(points[ground.above(points) > CLEARANCE_M], focus)
    if not cluster.cells.any():
        raise refused("nothing stands where the cameras look")
    return [cluster.sphere] * len(clip), cluster_evidence(cluster, ground)


def surroundings(
    clip: Clip, world_from_camera: Float[np.ndarray, "frame 4 4"], focus: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "point 3"], GroundPlane | None]:
    """Return the points seen near a focus, tails and ears too, and the ground beneath it, if it is seen."""
    near_points, upward = [], []
    for frame in subsampling.evenly(len(clip), FRAMES):
        depth = clip.depth(frame)
        depth = np.where(supported(depth), depth, 0)
        view = depth_image(depth, clip.depth_intrinsics[frame], depth > 0, 2)
        world = rigid.apply(world_from_camera[frame], view.points.reshape(-1, 3).astype(float))
        up = (view.normals.reshape(-1, 3) @ world_from_camera[frame, :3, :3].T)[:, 1]
        near = (view.points.reshape(-1, 3)[:, 2] > 0) & (np.abs(world - focus).max(1) < REACH_M)
        near_points.append(world[near])
        upward.append(up[near] > MIN_UP)
    points, level = np.concatenate(near_points), np.concatenate(upward)
    seen = (points[level, 1] < focus[1] + MARGIN_M).sum() >= MIN_GROUND_POINTS
    return points, fit_ground(points[level], focus) if seen else None


def axes_focus(world_from_camera: Float[np.ndarray, "frame 4 4"]) -> Float[np.ndarray, "3"] | None:
    """Return the point nearest to all optical axes (robust least squares), meters.

    None if they are parallel, or meet behind most cameras because the phone turns on the spot.
    """
    center, forward = world_from_camera[:, :3, 3], world_from_camera[:, :3, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    weight = np.ones(len(center))
    for _ in range(10):
        total = (weight[:, None, None] * across).sum(0)
        if np.linalg.eigvalsh(total)[0] < MIN_AXIS_SPREAD * weight.sum():
            return None
        point = np.linalg.solve(total, np.einsum("f,fij,fj->i", weight, across, center))
        distance = np.linalg.norm(np.einsum("fij,fj->fi", across, point - center), axis=1)
        weight = 1 / (1 + (distance / AXIS_OUTLIER_M) ** 2)
    before_m = np.einsum("fi,fi->f", point - center, forward)
    return point if np.median(before_m) > NEAREST_M else None


def find_cluster(
    points_world: Float[np.ndarray, "point 3"], focus: Float[np.ndarray, "3"], min_hits: int = MIN_HITS
) -> Cluster:
    """Voxelize points; return the component that is large and near the focus, dilated by two voxels."""
    reach = REACH_M + 2 * VOXEL_M
    origin, count = focus - reach, int(np.ceil(2 * reach / VOXEL_M))
    at = np.floor((points_world - origin) / VOXEL_M).astype(int)
    at = at[((at >= 0) & (at < count)).all(1)]
    hits = np.bincount(np.ravel_multi_index(at.T, (count,) * 3), minlength=count**3).reshape((count,) * 3)
    filled = hits >= min_hits
    around = np.ones((3, 3, 3), bool)
    closed = np.asarray(scipy.ndimage.binary_closing(filled, around), bool) | filled
    component, components = cast("tuple[np.ndarray, int]", scipy.ndimage.label(closed, around))
    center = origin + (np.argwhere(filled) + 0.5) * VOXEL_M
    nearness = np.exp(-((np.linalg.norm(center - focus, axis=1) / 0.25) ** 2))
    score = np.bincount(component[filled], nearness, minlength=components + 1)
    own = (component == score.argmax()) & filled
    return Cluster(scipy.ndimage.binary_dilation(own, around, iterations=2), origin)


def cluster_evidence(cluster: Cluster, ground: GroundPlane, whole: bool = True) -> EvidenceOf:
    """Evidence of a cluster: its voxels well above the ground are animal, the rest is room.

    If they do not cover the ``whole`` animal, what stands beside them is unknown.
    """

    def evidence_of(frame: int, window: Window, sphere: Sphere) -> Evidence:
        known = np.isfinite(window.points_world[..., 0])
        inside, height = cluster.contains(window.points_world), ground.above(window.points_world)
        raised = window.points_world.copy()  # feet: voxels begin at the clearance
        raised[..., 1] += CLEARANCE_M
        inside |= cluster.contains(raised)
        log_odds = np.where(inside, np.clip((height - FOOT_M) / FOOT_SPREAD_M, -SURE, SURE), -SURE)
        log_odds[~known] = 0.0
        certainty = np.where(known, np.where(window.trusted, 1.0, 0.5), UNKNOWN)
        if not whole:
            near = np.linalg.norm(window.points_world - sphere.center_world, axis=-1) < sphere.radius_m
            uncertain = near & ~inside & (height > CLEARANCE_M)
            log_odds[uncertain], certainty[uncertain] = 0.0, UNKNOWN
        sure = window.trusted & (log_odds > 2)
        return Evidence(log_odds, certainty, sure, sure, sure, log_odds <= -2)

    return evidence_of


def foreground_evidence(clip: Clip, standing: EvidenceOf, size: tuple[int, int]) -> EvidenceOf:
    """Evidence of the clip's foreground, of which what is ``standing`` there for sure is part of the animal.

    ``size``: of working pictures.
    """

    def evidence_of(frame: int, window: Window, sphere: Sphere) -> Evidence:
        mask = cv2.resize(clip.foreground(frame), size[::-1], interpolation=cv2.INTER_NEAREST)
        inside = mask[window.rows, window.columns] > 0
        sure = standing(frame, window, sphere).animal & inside
        log_odds = np.where(inside, SURE, -SURE)
        return Evidence(log_odds, np.ones(inside.shape), sure, sure, sure, ~inside)

    return evidence_of
