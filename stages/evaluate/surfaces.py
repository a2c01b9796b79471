"""Surfaces against truth: points followed on the animal, chamfer distances of scene and animal."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from pipeline.geometry import rigid
from pipeline.geometry.meshes import RayCaster
from pipeline.metrics.metrics import Metrics, median, percentile
from stages.evaluate.registration import REFUSED, REFUSED_TENTH

NEAREST_M, RANGE_M = 0.05, 5.0
REACHED = 0.99
"""Share of the way to a point that must be free: the point is part of a surface itself."""


def matched_once(
    points_agent: Float[np.ndarray, "point 3"], true_vertices_agent: Iterable[Float[np.ndarray, "vertex 3"]]
) -> Int[np.ndarray, "point"]:
    """Match points at rest to vertices of the nearest of several true surfaces, all in our agent frame."""
    answers = [KDTree(vertices).query(points_agent) for vertices in true_vertices_agent]
    return np.asarray(min(answers, key=lambda answer: np.mean(answer[0]))[1])


def track_metrics(distances: Sequence[Float[np.ndarray, "point"]]) -> Metrics:
    """Summarize distances of followed points over all frames; unknown poses count as failures."""
    metrics = Metrics()
    every = np.concatenate(distances) if len(distances) else np.zeros(0)
    metrics.put("reconstruction/agent_track_m_median", median(every), REFUSED)
    metrics.put("reconstruction/agent_track_m_p90", percentile(every, 90), REFUSED_TENTH)
    return metrics


def seen_by(
    caster: RayCaster,
    points_world: Float[np.ndarray, "point 3"],
    world_from_camera: Float[np.ndarray, "camera 4 4"],
    intrinsics: Float[np.ndarray, "camera 3 3"],
    size: tuple[int, int],
) -> Bool[np.ndarray, "point"]:
    """Return which surface points some camera sees within 5 m: in its picture and not behind anything."""
    seen = np.zeros(len(points_world), bool)
    for camera, lens in zip(world_from_camera, intrinsics, strict=True):
        points_camera = rigid.apply(rigid.inverse(camera), points_world)
        pixel = points_camera @ lens.T
        inside = (points_camera[:, 2] > NEAREST_M) & (points_camera[:, 2] < RANGE_M)
        pixel = pixel[:, :2] / np.where(inside, points_camera[:, 2], 1)[:, None]
        inside &= ((pixel >= 0) & (pixel < size[::-1])).all(1) & ~seen
        direction = points_world[inside] - camera[:3, 3]
        hit = caster.cast(camera[:3, 3], direction).distance
        seen[np.flatnonzero(inside)[hit > REACHED]] = True
    return seen
