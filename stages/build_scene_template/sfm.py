"""Structure from motion over keyframes of the walk-through, with matches verified by depth.

`choose_keyframes` subsamples the clip, `reconstruct` returns the largest model at its own scale, or None.
Repetitive texture passes epipolar verification one period off. `verify_matches` keeps the inliers of one
rigid motion of the matched depth points, and drops pairs with few inliers or that contradict odometry.
"""

from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float, Int, Num

from pipeline.core.progress import log
from pipeline.data.clips import Clip, back_project_pixels, usable_depth
from pipeline.geometry import align, rigid, subsampling
from pipeline.mapping import colmap
from pipeline.mapping.bundle_adjustment import TrackedPoints, build_tracks
from pipeline.mapping.colmap import SparseModel, read_sparse_model
from stages.build_scene_template.config import SfmConfig

KEYFRAME_M, KEYFRAME_DEG = 0.12, 9.0
"""Translation (meters) or rotation (degrees) between keyframes, by odometry."""
KEYFRAME_S = 0.4
"""Time between keyframes where there is no odometry, seconds."""
FIRST_OCTAVE = -1
"""First SIFT octave; -1 upsamples the small stored pictures by two. 0 costs a third and finds half."""
PEAK_THRESHOLD = 0.004
"""SIFT's contrast threshold; plain walls need a low one (COLMAP's default is 0.0067)."""
LOOP_M, LOOP_DEG = 1.0, 35.0
"""Loop candidates by odometry: largest distance (meters) and angle between optical axes (degrees)."""
FIRST_STEP, SECOND_STEP = 5, 3
"""Without odometry every fifth keyframe is matched with every third one."""
DATABASE = "database.db"
MIN_KEYFRAMES = 3
"""Least registered keyframes of an accepted model."""
INLIER_M = 0.06
"""RANSAC inlier threshold, meters: twice the depth noise at 4 m."""
MIN_INLIER_RATIO, MIN_MATCHES = 0.5, 8
"""Least inlier ratio and number of inliers among matches with depth."""
MAX_DIFF_DEG, MAX_DIFF_M = 6.0, 0.3
"""Largest difference from odometry, degrees and meters: allows drift, but not a repeated texture."""
RANSAC_TRIPLETS = 80
MIN_SIDE_M = 0.15
"""Least side of a RANSAC sample's triangle, meters."""
MIN_DEPTH_M = 0.1
"""Smaller depth counts as missing, meters."""


def choose_keyframes(clip: Clip, config: SfmConfig) -> Int[np.ndarray, "key"]:
    """Subsample a clip by odometry, or by time without it, to at most ``max_keyframes`` sharpest frames."""
    if clip.odometry_from_camera is None:
        progress = clip.timestamp_s / KEYFRAME_S
    else:
        pose = clip.odometry_from_camera
        moved = np.linalg.norm(np.diff(pose[:, :3, 3], axis=0), axis=1) / KEYFRAME_M
        rotated = np.rad2deg(rigid.rotation_angle(pose[:-1, :3, :3], pose[1:, :3, :3])) / KEYFRAME_DEG
        progress = np.concatenate([[0.0], np.cumsum(np.maximum(moved, rotated))])
    progress = progress * min(1.0, (config.max_keyframes - 2) / max(progress[-1], 1e-6))
    return subsampling.sharpest_of_steps(np.floor(progress).astype(int), clip.quality)


def choose_pairs(
    clip: Clip, keyframes: Int[np.ndarray, "key"], config: SfmConfig
) -> Int[np.ndarray, "pair 2"]:
    """Pair each keyframe with its successors and loop candidates by odometry; without it, with a grid."""
    count = len(keyframes)
    first, second = np.triu_indices(count, 1)
    chosen = second - first <= config.overlap
    if clip.odometry_from_camera is None:
        chosen |= (first % FIRST_STEP == 0) & (second % SECOND_STEP == 0)
    else:
        pose = clip.odometry_from_camera[keyframes]
        near = np.linalg.norm(pose[first, :3, 3] - pose[second, :3, 3], axis=1) / LOOP_M
        turned = np.arccos(np.clip((pose[first, :3, 2] * pose[second, :3, 2]).sum(1), -1, 1))
        near = np.maximum(near, turned / np.deg2rad(LOOP_DEG))
        for key in range(count):
            candidates = np.flatnonzero((first == key) & ~chosen & (near < 1))
            order = np.argsort(near[candidates], kind="stable")
            chosen[candidates[order[: config.loops_per_keyframe]]] = True
    return np.stack([first[chosen], second[chosen]], axis=1)


def reconstruct(clip: Clip, config: SfmConfig, workspace: Path, seed: int) -> SparseModel | None:
    """Run COLMAP on the keyframes in an empty workspace; None if no model has at least three of them."""
    colmap.seed_everything(seed)
    keyframes = choose_keyframes(clip, config)
    names = [f"{frame:06d}.jpg" for frame in keyframes]
    database, pictures = workspace / DATABASE, clip.folder / "color"
    sift = dict(max_num_features=config.features, first_octave=FIRST_OCTAVE, peak_threshold=PEAK_THRESHOLD)
    colmap.extract(database, pictures, names, colmap.pinhole(np.median(clip.intrinsics, axis=0)), sift)
    colmap.match(database, ((names[a], names[b]) for a, b in choose_pairs(clip, keyframes, config)), seed)
    verified, pairs = verify_matches(clip, database, np.random.default_rng(seed))
    log(f"depth confirms {verified} of {pairs} matched pairs of {len(keyframes)} keyframes")
    models = pycolmap.incremental_mapping(database, pictures, workspace, colmap.mapping_options(seed))
    model = colmap.largest(models)
    return read_sparse_model(model) if model and model.num_reg_images() >= MIN_KEYFRAMES else None


def back_project(
    clip: Clip, frame: int, pixel: Float[np.ndarray, "sample 2"]
) -> Float[np.ndarray, "sample 3"]:
    """Back-project color pixels to the camera frame; NaN where depth is unknown or of low confidence."""
    return back_project_pixels(clip, frame, pixel, usable_depth(clip, frame, nearest_m=MIN_DEPTH_M))


def verify_matches(clip: Clip, database: Path, rng: np.random.Generator) -> tuple[int, int]:
    """Keep only matches that depth confirms; return the number of pairs left and of all pairs."""
    with pycolmap.Database.open(database) as table:
        frames = {image.image_id: int(image.name[:6]) for image in table.read_all_images()}
        points = {
            key: back_project(clip, frame, table.read_keypoints(key)[:, :2].astype(float))
            for key, frame in frames.items()
        }
        pairs = sorted(pycolmap.pair_id_to_image_pair(pair) for pair in table.read_two_view_geometries()[0])
        verified = 0
        for pair in pairs:
            geometry = table.read_two_view_geometry(*pair)
            inlier_matches = _verified_matches(clip, frames, points, *pair, geometry.inlier_matches, rng)
            table.delete_two_view_geometry(*pair)
            if len(inlier_matches):
                geometry.inlier_matches = inlier_matches
                table.write_two_view_geometry(*pair, geometry)
                verified += 1
    return verified, len(pairs)


def tracked_points(clip: Clip, database: Path, keyframes: Int[np.ndarray, "key"]) -> TrackedPoints:
    """Chain COLMAP's matches to tracks with depth, also those of unregistered keyframes."""
    with pycolmap.Database.open(database) as table:
        images = sorted(table.read_all_images(), key=lambda image: image.name)
        pixels = [table.read_keypoints(image.image_id)[:, :2].astype(float) for image in images]
        pairs = sorted(pycolmap.pair_id_to_image_pair(pair) for pair in table.read_two_view_geometries()[0])
        matches = {pair: table.read_two_view_geometry(*pair).inlier_matches.astype(int) for pair in pairs}
    assert len(images) == len(keyframes), f"{len(images)} pictures of {len(keyframes)} keyframes"
    index_of = {image.image_id: index for index, image in enumerate(images)}
    links = [(index_of[a], index_of[b], found) for (a, b), found in matches.items()]
    depths = [
        back_project(clip, int(frame), pixel)[:, 2] for frame, pixel in zip(keyframes, pixels, strict=True)
    ]
    return build_tracks(pixels, depths, clip.intrinsics[keyframes], np.zeros(len(pixels), int), links)


def _verified_matches(clip, frames, points, first, second, matches, rng) -> Num[np.ndarray, "match 2"]:
    """Return the depth-consistent matches of a pair; none if the pair is rejected."""
    if len(matches) == 0:
        return matches
    source, target = points[second][matches[:, 1]], points[first][matches[:, 0]]
    known = np.isfinite(source[:, 0]) & np.isfinite(target[:, 0])
    if known.sum() < MIN_MATCHES:
        return matches[:0]
    first_from_second, inlier = align.ransac_rigid(
        source[known], target[known],
        threshold_m=INLIER_M, iterations=RANSAC_TRIPLETS, rng=rng, min_side_m=MIN_SIDE_M,
    )  # fmt: skip
    if inlier.sum() < max(MIN_MATCHES, MIN_INLIER_RATIO * known.sum()):
        return matches[:0]
    if clip.odometry_from_camera is not None:
        odometry = clip.odometry_from_camera
        expected = rigid.inverse(odometry[frames[first]]) @ odometry[frames[second]]
        turned = np.rad2deg(rigid.rotation_angle(expected[:3, :3], first_from_second[:3, :3]))
        if turned > MAX_DIFF_DEG or np.linalg.norm(expected[:3, 3] - first_from_second[:3, 3]) > MAX_DIFF_M:
            return matches[:0]
    known[known] = inlier
    return matches[known]
