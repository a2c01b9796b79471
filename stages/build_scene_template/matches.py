"""Matches that depth confirms: a repeating rug looks like itself one tile further on, but not at the right distance.

`points_under` lifts pixels by depth; `confirm` keeps of every matched pair of keyframes the matches that
one rigid motion of their depth points explains, and drops the pair when they are few or contradict odometry.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float, Int

from pipeline.files.clips import Clip
from pipeline.space import align, cameras, rigid


@dataclass(frozen=True)
class ConfirmOptions:
    """When a pair of keyframes is believed to see the same place."""

    threshold_m: float = 0.06
    """Matched depth points this close after one rigid motion agree, metres."""
    least_share: float = 0.5
    """Share of the matches with depth that must agree."""
    least_matches: int = 8
    """And at least so many."""
    most_deg: float = 6.0
    """The motion may turn by this much other than the odometry says, degrees ..."""
    most_m: float = 0.3
    """... and move by this much, metres."""
    iterations: int = 80
    """RANSAC triplets a pair."""


def points_under(clip: Clip, frame: int, pixel: Float[np.ndarray, "sample 2"]) -> Float[np.ndarray, "sample 3"]:
    """Lift colour pixels by the depth under them to camera axes; NaN where it is unknown or of low confidence."""
    depth, confidence = clip.depth(frame), clip.confidence(frame)
    limit = np.array(clip.depth_size[::-1])
    column, row = np.clip(np.floor(pixel * limit / np.array(clip.color_size[::-1])).astype(int), 0, limit - 1).T
    z = np.where(confidence[row, column] >= 1, depth[row, column], 0)
    points = cameras.unproject(pixel, clip.intrinsics[frame]) * z[:, None]
    return np.where((z > 0.1)[:, None], points, np.nan)


def confirm(clip: Clip, database: Path, options: ConfirmOptions, rng: np.random.Generator) -> tuple[int, int]:
    """Rewrite COLMAP's verified matches in its database to those that depth confirms; return (pairs kept, pairs)."""
    with pycolmap.Database.open(database) as table:
        images = {image.image_id: int(image.name[:6]) for image in table.read_all_images()}
        points = {key: points_under(clip, frame, table.read_keypoints(key)[:, :2].astype(float)) for key, frame in images.items()}
        pairs = sorted(pycolmap.pair_id_to_image_pair(pair) for pair in table.read_two_view_geometries()[0])
        kept = 0
        for first, second in pairs:
            geometry = table.read_two_view_geometry(first, second)
            good = _confirmed(clip, images[first], images[second], points[first], points[second], geometry.inlier_matches, options, rng)
            table.delete_two_view_geometry(first, second)
            if len(good):
                geometry.inlier_matches = good
                table.write_two_view_geometry(first, second, geometry)
                kept += 1
    return kept, len(pairs)


def _confirmed(clip, first, second, points_first, points_second, matches, options, rng) -> Int[np.ndarray, "match 2"]:
    """Return the matches of a pair that depth confirms, none where the pair as a whole is not believed."""
    if len(matches) == 0:
        return matches[:0]
    source, target = points_second[matches[:, 1]], points_first[matches[:, 0]]
    known = np.isfinite(source[:, 0]) & np.isfinite(target[:, 0])
    if known.sum() < options.least_matches:
        return matches[:0]
    first_from_second, inlier = align.ransac_rigid(
        source[known], target[known], threshold_m=options.threshold_m, iterations=options.iterations, rng=rng, spread_m=0.15
    )
    if inlier.sum() < max(options.least_matches, options.least_share * known.sum()):
        return matches[:0]
    if clip.odometry_from_camera is not None:
        told = rigid.inverse(clip.odometry_from_camera[first]) @ clip.odometry_from_camera[second]
        turned = np.rad2deg(rigid.rotation_angle(told[:3, :3], first_from_second[:3, :3]))
        if turned > options.most_deg or np.linalg.norm(told[:3, 3] - first_from_second[:3, 3]) > options.most_m:
            return matches[:0]
    known[known] = inlier
    return matches[known]
