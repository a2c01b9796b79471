"""Structure from motion over keyframes of the walk-through, matches verified by depth.

`choose_keyframes` subsamples the clip, `reconstruct` returns the largest model in its own scale, or None.
A repeating rug matches one tile further on, at the wrong distance: `confirm` keeps the matches of each pair
that one rigid motion of their depth points explains, and drops pairs that are few or contradict odometry.
"""

import itertools
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float, Int, Num

from pipeline.core.progress import log
from pipeline.data.clips import Clip
from pipeline.geometry import align, cameras, rigid
from pipeline.mapping import colmap
from pipeline.mapping.bundle_adjustment import TrackedPoints, chained
from pipeline.mapping.colmap import SparseModel, read_sparse_model
from stages.build_scene_template.config import SfmConfig

KEYFRAME_M, KEYFRAME_DEG = 0.12, 9.0
"""A keyframe follows the last one after this much motion or turning, by odometry, metres and degrees."""
KEYFRAME_S = 0.4
"""Time between keyframes where there is no odometry, seconds."""
FIRST_OCTAVE = -1
"""Doubles the picture before SIFT: stored pictures are small; 0 costs a third and finds half."""
PEAK_THRESHOLD = 0.004
"""SIFT's contrast threshold; plain walls need a low one (COLMAP's default is 0.0067)."""
LOOP_M, LOOP_DEG = 1.0, 35.0
"""Loop candidates by odometry: keyframes this close, metres, whose axes differ by less, degrees."""
FIRST_STEP, SECOND_STEP = 5, 3
"""Without odometry every fifth keyframe is matched with every third one."""
DATABASE = "database.db"
MIN_KEYFRAMES = 3
"""A smaller model is none."""
AGREE_M = 0.06
"""Matched depth points this close after one rigid motion agree, metres: twice the depth noise at 4 m."""
MIN_SHARE, MIN_MATCHES = 0.5, 8
"""Share and number of the matches with depth that must agree."""
MAX_DEG, MAX_M = 6.0, 0.3
"""The motion may differ by this much from the odometry's, degrees and metres: drift, not another tile."""
RANSAC_TRIPLETS = 80
MIN_SIDE_M = 0.15
"""Least side of a RANSAC triplet, metres."""
NEAREST_M = 0.1
"""Depth below this is none, metres."""


def choose_keyframes(clip: Clip, config: SfmConfig) -> Int[np.ndarray, "key"]:
    """Subsample a clip by its odometry's motion, or by time where there is none; fewer than the bound."""
    if clip.odometry_from_camera is None:
        progress = clip.timestamp_s / KEYFRAME_S
    else:
        pose = clip.odometry_from_camera
        moved = np.linalg.norm(np.diff(pose[:, :3, 3], axis=0), axis=1) / KEYFRAME_M
        rotated = np.rad2deg(rigid.rotation_angle(pose[:-1, :3, :3], pose[1:, :3, :3])) / KEYFRAME_DEG
        progress = np.concatenate([[0.0], np.cumsum(np.maximum(moved, rotated))])
    progress = progress * min(1.0, (config.max_keyframes - 2) / max(progress[-1], 1e-6))
    step = np.floor(progress).astype(int)
    starts = np.flatnonzero(np.diff(step, prepend=-1) > 0)
    bounds = np.append(starts, len(step))
    return np.array([low + int(clip.quality[low:high].argmax()) for low, high in itertools.pairwise(bounds)])


def choose_pairs(
    clip: Clip, keyframes: Int[np.ndarray, "key"], config: SfmConfig
) -> Int[np.ndarray, "pair 2"]:
    """Pair each keyframe with successors and with loop candidates by odometry, or a coarse grid without."""
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
    """Run COLMAP on the keyframes in an empty workspace; None when no model has at least three of them."""
    colmap.seed_everything(seed)
    keyframes = choose_keyframes(clip, config)
    names = [f"{frame:06d}.jpg" for frame in keyframes]
    database, pictures = workspace / DATABASE, clip.folder / "color"
    sift = dict(max_num_features=config.features, first_octave=FIRST_OCTAVE, peak_threshold=PEAK_THRESHOLD)
    colmap.extract(database, pictures, names, colmap.pinhole(np.median(clip.intrinsics, axis=0)), sift)
    colmap.match(database, ((names[a], names[b]) for a, b in choose_pairs(clip, keyframes, config)), seed)
    confirmed, pairs = confirm(clip, database, np.random.default_rng(seed))
    log(f"depth confirms {confirmed} of {pairs} matched pairs of {len(keyframes)} keyframes")
    models = pycolmap.incremental_mapping(database, pictures, workspace, colmap.mapping_options(seed))
    if not models:
        return None
    largest = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    return read_sparse_model(largest) if largest.num_reg_images() >= MIN_KEYFRAMES else None


def points_under(
    clip: Clip, frame: int, pixel: Float[np.ndarray, "sample 2"]
) -> Float[np.ndarray, "sample 3"]:
    """Lift colour pixels by the depth under them to camera axes; NaN where unknown or of low confidence."""
    depth, confidence = clip.depth(frame), clip.confidence(frame)
    limit = np.array(clip.depth_size[::-1])
    at = np.floor(pixel * limit / np.array(clip.color_size[::-1])).astype(int)
    column, row = np.clip(at, 0, limit - 1).T
    z = np.where(confidence[row, column] >= 1, depth[row, column], 0)
    points = cameras.unproject(pixel, clip.intrinsics[frame]) * z[:, None]
    return np.where((z > NEAREST_M)[:, None], points, np.nan)


def confirm(clip: Clip, database: Path, rng: np.random.Generator) -> tuple[int, int]:
    """Rewrite COLMAP's verified matches to those that depth confirms; return the pairs left, and all."""
    with pycolmap.Database.open(database) as table:
        frames = {image.image_id: int(image.name[:6]) for image in table.read_all_images()}
        points = {
            key: points_under(clip, frame, table.read_keypoints(key)[:, :2].astype(float))
            for key, frame in frames.items()
        }
        pairs = sorted(pycolmap.pair_id_to_image_pair(pair) for pair in table.read_two_view_geometries()[0])
        confirmed = 0
        for pair in pairs:
            geometry = table.read_two_view_geometry(*pair)
            good = _confirmed(clip, frames, points, *pair, geometry.inlier_matches, rng)
            table.delete_two_view_geometry(*pair)
            if len(good):
                geometry.inlier_matches = good
                table.write_two_view_geometry(*pair, geometry)
                confirmed += 1
    return confirmed, len(pairs)


def tracked_points(clip: Clip, database: Path, keyframes: Int[np.ndarray, "key"]) -> TrackedPoints:
    """Chain COLMAP's matches to points, with the depth under each pixel.

    Matches of keyframes that no model registered count too. What shows twice in a keyframe is no point.
    """
    with pycolmap.Database.open(database) as table:
        images = sorted(table.read_all_images(), key=lambda image: image.name)
        pixels = [table.read_keypoints(image.image_id)[:, :2].astype(float) for image in images]
        pairs = sorted(pycolmap.pair_id_to_image_pair(pair) for pair in table.read_two_view_geometries()[0])
        matches = {pair: table.read_two_view_geometry(*pair).inlier_matches.astype(int) for pair in pairs}
    assert len(images) == len(keyframes), f"{len(images)} pictures of {len(keyframes)} keyframes"
    place = {image.image_id: index for index, image in enumerate(images)}
    links = [(place[a], place[b], found) for (a, b), found in matches.items()]
    depths = [
        points_under(clip, int(frame), pixel)[:, 2] for frame, pixel in zip(keyframes, pixels, strict=True)
    ]
    return chained(pixels, depths, clip.intrinsics[keyframes], np.zeros(len(pixels), int), links)


def _confirmed(clip, frames, points, first, second, matches, rng) -> Num[np.ndarray, "match 2"]:
    """Return the matches of a pair that depth confirms, none where the pair as a whole is not believed."""
    if len(matches) == 0:
        return matches
    source, target = points[second][matches[:, 1]], points[first][matches[:, 0]]
    known = np.isfinite(source[:, 0]) & np.isfinite(target[:, 0])
    if known.sum() < MIN_MATCHES:
        return matches[:0]
    first_from_second, inlier = align.ransac_rigid(
        source[known], target[known],
        threshold_m=AGREE_M, iterations=RANSAC_TRIPLETS, rng=rng, min_side_m=MIN_SIDE_M,
    )  # fmt: skip
    if inlier.sum() < max(MIN_MATCHES, MIN_SHARE * known.sum()):
        return matches[:0]
    if clip.odometry_from_camera is not None:
        odometry = clip.odometry_from_camera
        expected = rigid.inverse(odometry[frames[first]]) @ odometry[frames[second]]
        turned = np.rad2deg(rigid.rotation_angle(expected[:3, :3], first_from_second[:3, :3]))
        if turned > MAX_DEG or np.linalg.norm(expected[:3, 3] - first_from_second[:3, 3]) > MAX_M:
            return matches[:0]
    known[known] = inlier
    return matches[known]
