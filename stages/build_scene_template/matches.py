"""Geometric verification of matches by depth: a repeating rug matches one tile further on, at the wrong
distance.

`points_under` lifts pixels by depth; `confirm` keeps the matches of each keyframe pair that one rigid motion
of their depth points explains, and drops the pair when they are few or contradict odometry.
"""

from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float, Num

from pipeline.data.clips import Clip
from pipeline.geometry import align, cameras, rigid

AGREE_M = 0.06
"""Matched depth points this close after one rigid motion agree, metres: twice the depth noise at 4 m."""
LEAST_SHARE, LEAST_MATCHES = 0.5, 8
"""Share and number of the matches with depth that must agree."""
MOST_DEG, MOST_M = 6.0, 0.3
"""The motion may differ by this much from the odometry's, degrees and metres: room for drift, not for another
tile."""
RANSAC_TRIPLETS = 80
LEAST_SIDE_M = 0.15
"""Least side of a RANSAC triplet, metres."""
NEAREST_M = 0.1
"""Depth below this is none, metres."""


def points_under(
    clip: Clip, frame: int, pixel: Float[np.ndarray, "sample 2"]
) -> Float[np.ndarray, "sample 3"]:
    """Lift colour pixels by the depth under them to camera axes; NaN where it is unknown or of low
    confidence."""
    depth, confidence = clip.depth(frame), clip.confidence(frame)
    limit = np.array(clip.depth_size[::-1])
    column, row = np.clip(
        np.floor(pixel * limit / np.array(clip.color_size[::-1])).astype(int), 0, limit - 1
    ).T
    z = np.where(confidence[row, column] >= 1, depth[row, column], 0)
    points = cameras.unproject(pixel, clip.intrinsics[frame]) * z[:, None]
    return np.where((z > NEAREST_M)[:, None], points, np.nan)


def confirm(clip: Clip, database: Path, rng: np.random.Generator) -> tuple[int, int]:
    """Rewrite COLMAP's verified matches in its database to those that depth confirms; return (pairs kept,
    pairs)."""
    with pycolmap.Database.open(database) as table:
        images = {image.image_id: int(image.name[:6]) for image in table.read_all_images()}
        points = {
            key: points_under(clip, frame, table.read_keypoints(key)[:, :2].astype(float))
            for key, frame in images.items()
        }
        pairs = sorted(pycolmap.pair_id_to_image_pair(pair) for pair in table.read_two_view_geometries()[0])
        kept = 0
        for first, second in pairs:
            geometry = table.read_two_view_geometry(first, second)
            good = _confirmed(
                clip,
                images[first],
                images[second],
                points[first],
                points[second],
                geometry.inlier_matches,
                rng,
            )
            table.delete_two_view_geometry(first, second)
            if len(good):
                geometry.inlier_matches = good
                table.write_two_view_geometry(first, second, geometry)
                kept += 1
    return kept, len(pairs)


def _confirmed(clip, first, second, points_first, points_second, matches, rng) -> Num[np.ndarray, "match 2"]:
    """Return the matches of a pair that depth confirms, none where the pair as a whole is not believed."""
    if len(matches) == 0:
        return matches[:0]
    source, target = points_second[matches[:, 1]], points_first[matches[:, 0]]
    known = np.isfinite(source[:, 0]) & np.isfinite(target[:, 0])
    if known.sum() < LEAST_MATCHES:
        return matches[:0]
    first_from_second, inlier = align.ransac_rigid(
        source[known],
        target[known],
        threshold_m=AGREE_M,
        iterations=RANSAC_TRIPLETS,
        rng=rng,
        least_side_m=LEAST_SIDE_M,
    )
    if inlier.sum() < max(LEAST_MATCHES, LEAST_SHARE * known.sum()):
        return matches[:0]
    if clip.odometry_from_camera is not None:
        expected = rigid.inverse(clip.odometry_from_camera[first]) @ clip.odometry_from_camera[second]
        turned = np.rad2deg(rigid.rotation_angle(expected[:3, :3], first_from_second[:3, :3]))
        if turned > MOST_DEG or np.linalg.norm(expected[:3, 3] - first_from_second[:3, 3]) > MOST_M:
            return matches[:0]
    known[known] = inlier
    return matches[known]
