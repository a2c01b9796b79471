"""Structure from motion over keyframes of the walk-through with COLMAP, on one CPU thread and with fixed seeds.

`choose_keyframes` thins the clip, `reconstruct` returns the largest model in its own scale, or None.
"""

import itertools
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Int

from pipeline.files.clips import Clip
from pipeline.progress import log
from pipeline.space import colmap, rigid
from pipeline.space.sparse import Sparse, sparse_from_model
from stages.build_scene_template.matches import ConfirmOptions, confirm


@dataclass(frozen=True)
class SfmOptions:
    """How keyframes are chosen, matched and mapped."""

    keyframe_m: float = 0.12
    """A keyframe follows the last one after this much motion, metres (odometry)."""
    keyframe_deg: float = 9.0
    """... or after this much turning, degrees."""
    keyframe_s: float = 0.4
    """Time between keyframes where there is no odometry, seconds."""
    most_keyframes: int = 90
    """Upper bound; steps are widened until it holds."""
    features: int = 1500
    """SIFT features kept per keyframe."""
    first_octave: int = -1
    """-1 doubles the picture before SIFT (small pictures need it), 0 does not and costs a third."""
    peak_threshold: float = 0.004
    """SIFT's contrast threshold; plain walls need a low one."""
    overlap: int = 6
    """Keyframes matched with this many successors."""
    loop_m: float = 1.0
    """Loop closure: also match keyframes whose odometry is this close, metres ..."""
    loop_deg: float = 35.0
    """... and whose viewing directions differ by less than this, degrees."""
    loops_per_keyframe: int = 4
    """At most this many loop candidates a keyframe."""
    confirm: ConfirmOptions = field(default_factory=ConfirmOptions)
    """When depth confirms matches."""


def choose_keyframes(clip: Clip, options: SfmOptions) -> Int[np.ndarray, "key"]:
    """Thin a clip by its odometry's motion, or by time where there is none; always fewer than the bound."""
    if clip.odometry_from_camera is None:
        progress = clip.timestamp_s / options.keyframe_s
    else:
        pose = clip.odometry_from_camera
        moved = np.linalg.norm(np.diff(pose[:, :3, 3], axis=0), axis=1) / options.keyframe_m
        turned = np.rad2deg(rigid.rotation_angle(pose[:-1, :3, :3], pose[1:, :3, :3])) / options.keyframe_deg
        progress = np.concatenate([[0.0], np.cumsum(np.maximum(moved, turned))])
    progress = progress * min(1.0, (options.most_keyframes - 2) / max(progress[-1], 1e-6))
    step = np.floor(progress).astype(int)
    starts = np.flatnonzero(np.diff(step, prepend=-1) > 0)
    bounds = np.append(starts, len(step))
    return np.array([low + int(clip.quality[low:high].argmax()) for low, high in itertools.pairwise(bounds)])


def choose_pairs(clip: Clip, keyframes: Int[np.ndarray, "key"], options: SfmOptions) -> Int[np.ndarray, "pair 2"]:
    """Pair each keyframe with its successors, and with those that odometry says look at the same place again."""
    count = len(keyframes)
    first, second = np.triu_indices(count, 1)
    chosen = second - first <= options.overlap
    if clip.odometry_from_camera is None:
        chosen |= (first % 5 == 0) & (second % 3 == 0)
    else:
        pose = clip.odometry_from_camera[keyframes]
        near = np.linalg.norm(pose[first, :3, 3] - pose[second, :3, 3], axis=1) / options.loop_m
        near = np.maximum(
            near,
            np.arccos(np.clip((pose[first, :3, 2] * pose[second, :3, 2]).sum(1), -1, 1)) / np.deg2rad(options.loop_deg),
        )
        for key in range(count):
            candidates = np.flatnonzero((first == key) & ~chosen & (near < 1))
            chosen[candidates[np.argsort(near[candidates], kind="stable")[: options.loops_per_keyframe]]] = True
    return np.stack([first[chosen], second[chosen]], axis=1)


def reconstruct(clip: Clip, options: SfmOptions, workspace: Path, seed: int) -> Sparse | None:
    """Run COLMAP on the keyframes in an empty workspace; None when no model has at least three of them."""
    colmap.seed_everything(seed)
    keyframes = choose_keyframes(clip, options)
    names = [f"{frame:06d}.jpg" for frame in keyframes]
    database, pictures = workspace / "database.db", clip.folder / "color"
    sift = {"max_num_features": options.features, "first_octave": options.first_octave, "peak_threshold": options.peak_threshold}
    colmap.extract(database, pictures, names, colmap.pinhole(np.median(clip.intrinsics, axis=0)), sift)
    colmap.match(database, ((names[a], names[b]) for a, b in choose_pairs(clip, keyframes, options)), seed)
    kept, pairs = confirm(clip, database, options.confirm, np.random.default_rng(seed))
    log(f"depth confirms {kept} of {pairs} matched pairs of {len(keyframes)} keyframes")
    models = pycolmap.incremental_mapping(database, pictures, workspace, colmap.mapping_options(seed))
    if not models:
        return None
    largest = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    return sparse_from_model(largest) if largest.num_reg_images() >= 3 else None
