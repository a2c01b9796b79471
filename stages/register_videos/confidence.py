"""How sure each pose is, told by the recording itself: how firmly it is held, and whether its picture looks like the place.

A frame of a wrong place can be held firmly, since rooms have floors and walls everywhere; but then its picture is no more
like its rendering than it is like renderings from poses that are wrong on purpose (targets and decoys, Elias & Gygi 2007).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.files.clips import Clip, Masks
from pipeline.space import rigid
from pipeline.space.meshes import RayCaster
from stages.register_videos.agent_roots import Roots
from stages.register_videos.likeness import likeness

NEAR_RAD, NEAR_M = np.deg2rad(2.0), 0.05
"""Within which a camera's pose counts as right."""


@dataclass(frozen=True)
class ConfidenceOptions:
    """How confidence is measured."""

    every_frames: int = 5
    """One frame in so many is compared with its rendering."""
    decoys: int = 120
    """Poses that are wrong on purpose: by ..."""
    decoy_size: tuple[float, float] = (1.5, 10.0)
    """... between these multiples of 2 degrees or 5 cm."""
    attempts: int = 3
    """A frame is held against the best of so many decoys, since alignment has taken the best of what it could reach."""
    bridge_s: float = 1.0
    """Time constant with which the likeness of single pictures is averaged, seconds: poses err together with their neighbours'."""
    adrift: float = 0.2
    """Factor on frames that no vote holds and that could not be followed from one that is held."""


@dataclass(frozen=True)
class Alike:
    """How much frames look like the template seen from their poses: correlation -1..1, NaN where nothing can be compared."""

    frame: Int[np.ndarray, "compared"]
    targets: Float[np.ndarray, "compared"]
    decoys: Float[np.ndarray, "decoy"]


def compare(
    clip: Clip,
    masks: Masks,
    caster: RayCaster,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    options: ConfidenceOptions,
    rng: np.random.Generator,
) -> Alike:
    """Compare frames with renderings at their poses and at poses that are wrong on purpose."""

    def seen(frame: int, world_from_camera: Float[np.ndarray, "4 4"]) -> float:
        return likeness(clip, masks, caster, frame, world_from_camera)

    chosen = np.unique(np.linspace(0, len(clip) - 1, max(len(clip) // options.every_frames, 20)).astype(int))
    wrong = rng.integers(0, len(clip), options.decoys)
    twist = rigid.exp(_wrong_twists(options, rng))
    return Alike(
        chosen,
        np.array([seen(int(frame), world_from_camera[frame]) for frame in chosen]),
        np.array([seen(int(frame), world_from_camera[frame] @ off) for frame, off in zip(wrong, twist, strict=True)]),
    )


def _wrong_twists(options, rng):
    """Draw motions whose turn or step, or both, is the drawn multiple of what counts as near."""
    low, high = np.log(options.decoy_size)
    size = np.exp(rng.uniform(low, high, options.decoys))[:, None]
    part = rng.uniform(0, 1, (options.decoys, 2))
    part /= part.max(1, keepdims=True)
    turn, step = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in rng.normal(size=(2, options.decoys, 3)))
    return np.concatenate([turn * part[:, :1] * size * NEAR_RAD, step * part[:, 1:] * size * NEAR_M], axis=1)


def looks_right(timestamp_s: Float[np.ndarray, "frame"], alike: Alike, options: ConfidenceOptions) -> Float[np.ndarray, "frame"]:
    """Return how likely each frame shows the place where it is believed to be, by the pictures around it."""
    known = np.isfinite(alike.targets)
    targets = averaged(timestamp_s, timestamp_s[alike.frame[known]], alike.targets[known], options.bridge_s)
    return right_place(targets, alike.decoys, options.attempts)


def camera_confidence(
    spread: Float[np.ndarray, "frame 6 6"],
    looks: Float[np.ndarray, "frame"],
    anchored: Bool[np.ndarray, "frame"],
    options: ConfidenceOptions,
    rng: np.random.Generator,
) -> Float[np.ndarray, "frame"]:
    """Return P(camera within 2 deg and 5 cm): that it is held so firmly, times that it is the right place."""
    return near_probability(spread, rng) * looks * np.where(anchored, 1.0, options.adrift)


def right_place(targets: Float[np.ndarray, "frame"], decoys: Float[np.ndarray, "decoy"], attempts: int) -> Float[np.ndarray, "frame"]:
    """Return one minus the q-value: the least share of decoys over the share of targets that look at least so much alike, of
    all limits that a frame passes; 0 where nothing can be compared.
    """
    decoys, known = decoys[np.isfinite(decoys)], np.flatnonzero(np.isfinite(targets))
    order = known[np.argsort(targets[known], kind="stable")]
    limit, found = targets[order], np.zeros(len(targets))
    passing = (0.5 + len(decoys) - np.searchsorted(np.sort(decoys), limit)) / (1 + len(decoys))
    wrong = (1 - (1 - passing) ** attempts) / ((len(order) - np.searchsorted(limit, limit)) / max(len(targets), 1))
    found[order] = np.maximum.accumulate(np.maximum(1 - wrong, 0.0))
    return found


def near_probability(spread: Float[np.ndarray, "frame 6 6"], rng: np.random.Generator, draws: int = 400) -> Float[np.ndarray, "frame"]:
    """Return how likely a twist of zero mean and this covariance stays within 2 deg and 5 cm."""
    normal, found = rng.normal(size=(6, draws)), np.empty(len(spread))
    variance, axes = np.linalg.eigh(spread)
    for frame, root in enumerate(axes * np.sqrt(np.maximum(variance, 0))[:, None, :]):
        drawn = root @ normal
        found[frame] = ((np.linalg.norm(drawn[:3], axis=0) < NEAR_RAD) & (np.linalg.norm(drawn[3:], axis=0) < NEAR_M)).mean()
    return found


def averaged(
    timestamp_s: Float[np.ndarray, "frame"], known_s: Float[np.ndarray, "known"], values: Float[np.ndarray, "known"], sigma_s: float
) -> Float[np.ndarray, "frame"]:
    """Average what is known at some times with a Gaussian's weights, cut at four sigma; NaN beyond. Time linear in the frames."""
    low = np.searchsorted(known_s, timestamp_s - 4 * sigma_s)
    high = np.searchsorted(known_s, timestamp_s + 4 * sigma_s, side="right")
    result = np.full(len(timestamp_s), np.nan)
    for frame, (first, last) in enumerate(zip(low, high, strict=True)):
        if last > first:
            weight = np.exp(-0.5 * ((known_s[first:last] - timestamp_s[frame]) / sigma_s) ** 2)
            result[frame] = weight @ values[first:last] / weight.sum()
    return result


def agent_confidence(roots: Roots, scale_m: float = 0.012, enough: float = 0.15) -> Float[np.ndarray, "frame"]:
    """Score each root 0..1: full for the video's usual fit in good view, less where it fits worse or little is seen;
    0 unseen.
    """
    if not roots.visible.any():
        return np.zeros(len(roots.visible))
    usual = np.nanquantile(roots.cost_m, 0.3)
    worse = np.maximum(np.nan_to_num(roots.cost_m, nan=1.0) - usual, 0) / scale_m
    return np.where(roots.visible, np.exp(-0.5 * worse**2) * np.minimum(roots.share / enough, 1.0), 0.0)
