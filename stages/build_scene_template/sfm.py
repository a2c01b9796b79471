"""Structure from motion over keyframes of the walk-through with COLMAP, on one CPU thread and with fixed
seeds.

`choose_keyframes` subsamples the clip, `reconstruct` returns the largest model in its own scale, or None.
"""

import itertools
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Int

from pipeline.core.progress import log
from pipeline.data.clips import Clip
from pipeline.geometry import rigid
from pipeline.mapping import colmap
from pipeline.mapping.colmap import SparseModel, read_sparse_model
from stages.build_scene_template.config import SfmConfig
from stages.build_scene_template.matches import confirm

KEYFRAME_M, KEYFRAME_DEG = 0.12, 9.0
"""A keyframe follows the last one after this much motion or turning, by odometry, metres and degrees."""
KEYFRAME_S = 0.4
"""Time between keyframes where there is no odometry, seconds."""
FIRST_OCTAVE = -1
"""Doubles the picture before SIFT: stored pictures are small; 0 costs a third and finds half."""
PEAK_THRESHOLD = 0.004
"""SIFT's contrast threshold; plain walls need a low one (COLMAP's default is 0.0067)."""
LOOP_M, LOOP_DEG = 1.0, 35.0
"""Loop candidates: keyframes this close by odometry (metres) whose axes differ by less than this
(degrees)."""
FIRST_STEP, SECOND_STEP = 5, 3
"""Without odometry every fifth keyframe is matched with every third one."""
LEAST_KEYFRAMES = 3
"""A smaller model is none."""


def choose_keyframes(clip: Clip, config: SfmConfig) -> Int[np.ndarray, "key"]:
    """Subsample a clip by its odometry's motion, or by time where there is none; always fewer than the
    bound."""
    if clip.odometry_from_camera is None:
        progress = clip.timestamp_s / KEYFRAME_S
    else:
        pose = clip.odometry_from_camera
        moved = np.linalg.norm(np.diff(pose[:, :3, 3], axis=0), axis=1) / KEYFRAME_M
        rotated = np.rad2deg(rigid.rotation_angle(pose[:-1, :3, :3], pose[1:, :3, :3])) / KEYFRAME_DEG
        progress = np.concatenate([[0.0], np.cumsum(np.maximum(moved, rotated))])
    progress = progress * min(1.0, (config.most_keyframes - 2) / max(progress[-1], 1e-6))
    step = np.floor(progress).astype(int)
    starts = np.flatnonzero(np.diff(step, prepend=-1) > 0)
    bounds = np.append(starts, len(step))
    return np.array([low + int(clip.quality[low:high].argmax()) for low, high in itertools.pairwise(bounds)])


def choose_pairs(
    clip: Clip, keyframes: Int[np.ndarray, "key"], config: SfmConfig
) -> Int[np.ndarray, "pair 2"]:
    """Pair each keyframe with its successors, and with loop candidates by odometry (without it, with a coarse
    grid)."""
    count = len(keyframes)
    first, second = np.triu_indices(count, 1)
    chosen = second - first <= config.overlap
    if clip.odometry_from_camera is None:
        chosen |= (first % FIRST_STEP == 0) & (second % SECOND_STEP == 0)
    else:
        pose = clip.odometry_from_camera[keyframes]
        near = np.linalg.norm(pose[first, :3, 3] - pose[second, :3, 3], axis=1) / LOOP_M
        near = np.maximum(
            near,
            np.arccos(np.clip((pose[first, :3, 2] * pose[second, :3, 2]).sum(1), -1, 1))
            / np.deg2rad(LOOP_DEG),
        )
        for key in range(count):
            candidates = np.flatnonzero((first == key) & ~chosen & (near < 1))
            chosen[candidates[np.argsort(near[candidates], kind="stable")[: config.loops_per_keyframe]]] = (
                True
            )
    return np.stack([first[chosen], second[chosen]], axis=1)


def reconstruct(clip: Clip, config: SfmConfig, workspace: Path, seed: int) -> SparseModel | None:
    """Run COLMAP on the keyframes in an empty workspace; None when no model has at least three of them."""
    colmap.seed_everything(seed)
    keyframes = choose_keyframes(clip, config)
    names = [f"{frame:06d}.jpg" for frame in keyframes]
    database, pictures = workspace / "database.db", clip.folder / "color"
    sift = {
        "max_num_features": config.features,
        "first_octave": FIRST_OCTAVE,
        "peak_threshold": PEAK_THRESHOLD,
    }
    colmap.extract(database, pictures, names, colmap.pinhole(np.median(clip.intrinsics, axis=0)), sift)
    colmap.match(database, ((names[a], names[b]) for a, b in choose_pairs(clip, keyframes, config)), seed)
    confirmed, pairs = confirm(clip, database, np.random.default_rng(seed))
    log(f"depth confirms {confirmed} of {pairs} matched pairs of {len(keyframes)} keyframes")
    models = pycolmap.incremental_mapping(database, pictures, workspace, colmap.mapping_options(seed))
    if not models:
        return None
    largest = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    return read_sparse_model(largest) if largest.num_reg_images() >= LEAST_KEYFRAMES else None
