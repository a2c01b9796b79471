"""Whether a recording's pictures, depth, intrinsics and camera poses agree with each other.

Points of one picture are lifted by its depth and found again in a later picture by the poses. If all four are
right, the two pictures correlate there, and every other reading of the recording (`Reading`: depth in another
unit, a mirrored picture, another clock ...) correlates less. Readings are compared pair by pair with a sign
test, so that no threshold depends on light, texture or sensor.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Num
from scipy.special import bdtrc

from pipeline.geometry import cameras, rigid

SIDE_PX, POINTS_A_SIDE = 320, 80
"""longer side of compared pictures, and points along the longer side of depth"""
CONTRAST_PX, MIN_VARIANCE = 6.0, 9.0
"""neighborhood of the local contrast normalization, pixels, and floor of the variance of gray values"""
OCCLUDED_M, OCCLUDED_SHARE = 0.05, 0.05
"""a point farther than the second picture's depth by this is hidden there"""
NEAREST_M = 0.05
MIN_NORM = 1e-9
MIN_POINTS = 200
"""least number of common points of a pair"""
MIN_PAIRS = 12
"""least number of pairs for a verdict: with fewer, no majority is significant"""
SIGNIFICANCE = 0.01
"""probability of a false verdict, over all readings together"""
DECOY_DEG = 3.0
"""rotation of deliberately wrong poses"""

CLOCKS = (-2, 2)
"""steps in time, in frames, by which depth and poses may be early or late"""


@dataclass(frozen=True)
class PosedPicture:
    """One upright frame."""

    gray: Num[np.ndarray, "height width"]
    """gray values 0 to 255; inside `check`, divided by local contrast"""
    intrinsics: Float[np.ndarray, "3 3"]
    depth: dict[int, Float[np.ndarray, "depth_height depth_width"]]
    """meters, 0 = unknown; of this frame (0) and of those `CLOCKS` later"""
    depth_intrinsics: Float[np.ndarray, "3 3"]
    world_from_camera: dict[int, Float[np.ndarray, "4 4"]]
    """likewise; the world is the phone's own"""


@dataclass(frozen=True)
class Reading:
    """One way to read a recording; by default as it is stored."""

    what: str = "as stored"
    depth: float = 1.0
    """factor on depth"""
    focal: float = 1.0
    """factor on the focal length"""
    center: tuple[float, float] = (0.0, 0.0)
    """shift of the principal point, shares of width and height"""
    mirrored: tuple[Literal["picture", "depth"], ...] = ()
    depth_of: int = 0
    pose_of: int = 0
    """frames by which depth or pose are taken later"""
    turn_deg: tuple[float, float] = (0.0, 0.0)
    """rotation of the second camera about its x and y axes"""


STORED = Reading()
READINGS = (
    *(Reading(f"depth times {factor:g}", depth=factor) for factor in (0.5, 0.8, 0.9, 1.1, 1.25, 2.0)),
    *(Reading(f"a focal length times {factor:g}", focal=factor) for factor in (0.8, 0.9, 1.1, 1.25)),
    *(
        Reading(
            f"a principal point moved by {x:g} and {y:g} % of width and height", center=(x / 100, y / 100)
        )
        for x, y in itertools.product((-5, 0, 5), repeat=2)
        if x or y
    ),
    Reading("mirrored pictures", mirrored=("picture",)),
    Reading("mirrored depth", mirrored=("depth",)),
    Reading("mirrored pictures and depth", mirrored=("picture", "depth")),
    *(Reading(f"depth {{:.2g}} s {'later' if step > 0 else 'earlier'}", depth_of=step) for step in CLOCKS),
    *(Reading(f"poses {{:.2g}} s {'later' if step > 0 else 'earlier'}", pose_of=step) for step in CLOCKS),
)
DECOYS = tuple(
    Reading("wrong poses", turn_deg=turn)
    for turn in ((DECOY_DEG, 0.0), (-DECOY_DEG, 0.0), (0.0, DECOY_DEG), (0.0, -DECOY_DEG))
)

Verdict = Literal["agree", "contradict", "unconfirmed", "untested"]


@dataclass(frozen=True)
class PictureAgreement:
    """What pictures say about depth, intrinsics and poses."""

    verdict: Verdict
    correlation: float
    """median over pairs of the recording as stored; NaN if nothing was compared"""
    pairs: int
    better: str = ""
    """the reading that explains the pictures better, if they contradict"""
    better_correlation: float = np.nan
    better_pairs: int = 0
    """pairs that it explains better"""

    @property
    def reason(self) -> str:
        """Return the verdict in words."""
        match self.verdict:
            case "agree":
                return "pictures, depth, intrinsics and device poses agree"
            case "contradict":
                share = f"{self.better_pairs} of {self.pairs} pairs of pictures"
                return f"{share} agree better with {self.better}"
            case "unconfirmed":
                return f"pictures agree with the device poses no better than with poses {DECOY_DEG:g} deg off"
            case "untested":
                return "too few pictures show the same things from another place"


def check(pairs: Sequence[tuple[PosedPicture, PosedPicture]], step_s: float) -> PictureAgreement:
    """Compare the recording as stored with all readings and with wrong poses; ``step_s``: between frames."""
    pairs = [(_normalized(first), _normalized(second)) for first, second in pairs]
    stored = np.array([correlation(*pair, STORED) for pair in pairs])
    pairs = [pair for pair, value in zip(pairs, stored, strict=True) if np.isfinite(value)]
    stored = stored[np.isfinite(stored)]
    if len(pairs) < MIN_PAIRS:
        return PictureAgreement("untested", np.nan, len(pairs))
    median = float(np.median(stored))
    decoys = [np.array([correlation(*pair, decoy) for pair in pairs]) for decoy in DECOYS]
    found = []
    for reading in READINGS:
        values = np.array([correlation(*pair, reading) for pair in pairs])
        if beats(values, stored) and all(beats(values, each) for each in decoys):
            better = float(np.median(values[np.isfinite(values)])), int((values > stored).sum())
            what = reading.what.format(step_s * abs(reading.depth_of + reading.pose_of))
            found.append(PictureAgreement("contradict", median, len(pairs), what, *better))
    if found:
        return max(found, key=lambda each: each.better_correlation)
    confirmed = all(beats(stored, each) for each in decoys)
    return PictureAgreement("agree" if confirmed else "unconfirmed", median, len(pairs))


def beats(
    values: Float[np.ndarray, "sample"], others: Float[np.ndarray, "sample"], tests: int = len(READINGS)
) -> bool:
    """Return whether values are larger in significantly more than half of the samples that both know.

    A sign test, corrected for as many ``tests`` (Bonferroni).
    """
    known = np.isfinite(values) & np.isfinite(others)
    larger, count = int((values > others)[known].sum()), int(known.sum())
    if count < MIN_PAIRS:
        return False
    as_many_by_chance = bdtrc(larger - 1, count, 0.5)
    return bool(as_many_by_chance < SIGNIFICANCE / tests)


def _normalized(picture: PosedPicture) -> PosedPicture:
    """Reduce the size and divide gray values by their local contrast, which light and exposure change."""
    factor = min(1.0, SIDE_PX / max(picture.gray.shape))
    gray = cv2.resize(picture.gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    values = gray.astype(np.float32)
    values -= cv2.GaussianBlur(values, (0, 0), CONTRAST_PX)
    variance = cv2.GaussianBlur(values**2, (0, 0), CONTRAST_PX)
    values /= np.sqrt(np.maximum(variance, MIN_VARIANCE))
    intrinsics = cameras.scale_intrinsics(picture.intrinsics, picture.gray.shape, gray.shape)
    return replace(picture, gray=values, intrinsics=intrinsics)


def correlation(first: PosedPicture, second: PosedPicture, reading: Reading) -> float:
    """Return the correlation of two normalized pictures where they show the same points; NaN if too few."""
    depth, seen_depth = (_depth(picture, reading) for picture in (first, second))
    grays = [each.gray[:, ::-1] if "picture" in reading.mirrored else each.gray for each in (first, second)]
    size, depth_size = first.gray.shape, depth.shape
    step = max(1, max(depth_size) // POINTS_A_SIDE)
    grid = np.mgrid[step // 2 : depth_size[0] : step, step // 2 : depth_size[1] : step]
    row, column = grid.reshape(2, -1)
    row, column = row[depth[row, column] > 0], column[depth[row, column] > 0]
    center = cameras.pixel_centers(row, column)
    rays = cameras.unproject(center, _intrinsics(first.depth_intrinsics, depth_size, reading))
    points = rigid.apply(_second_from_first(first, second, reading), rays * depth[row, column, None])
    pixel, z = cameras.project(points, _intrinsics(second.intrinsics, size, reading))
    inside = (z > NEAREST_M) & (pixel >= 1).all(-1) & (pixel < np.array(size[::-1]) - 1).all(-1)
    pixel, z, center = pixel[inside], z[inside], center[inside]
    measured = seen_depth[cameras.pixel_index(pixel * np.array(depth_size[::-1]) / size[::-1])]
    shown = (measured == 0) | (z < measured * (1 + OCCLUDED_SHARE) + OCCLUDED_M)
    if shown.sum() < MIN_POINTS:
        return np.nan
    own = center[shown] * np.array(size[::-1]) / depth_size[::-1]
    pairs = zip(grays, (own, pixel[shown]), strict=True)
    return correlated(*(cameras.sample_bilinear(gray, at[:, None])[:, 0] for gray, at in pairs))


def _depth(picture: PosedPicture, reading: Reading) -> Float[np.ndarray, "height width"]:
    depth = picture.depth[reading.depth_of] * np.float32(reading.depth)
    return depth[:, ::-1] if "depth" in reading.mirrored else depth


def _intrinsics(
    intrinsics: Float[np.ndarray, "3 3"], size: tuple[int, int], reading: Reading
) -> Float[np.ndarray, "3 3"]:
    read = intrinsics.astype(float)
    read[[0, 1], [0, 1]] *= reading.focal
    read[:2, 2] += np.array(reading.center) * size[::-1]
    return read


def _second_from_first(
    first: PosedPicture, second: PosedPicture, reading: Reading
) -> Float[np.ndarray, "4 4"]:
    poses = (each.world_from_camera[reading.pose_of] for each in (first, second))
    world_from_first, world_from_second = poses
    turn = rigid.rotation_from_vector(np.radians([*reading.turn_deg, 0.0]))
    return rigid.make(turn, np.zeros(3)) @ rigid.inverse(world_from_second) @ world_from_first


def correlated(first: Float[np.ndarray, "point"], second: Float[np.ndarray, "point"]) -> float:
    """Return the correlation of two samples, in -1..1; 0 if one is constant."""
    first, second = first - first.mean(), second - second.mean()
    return float(first @ second / max(np.linalg.norm(first) * np.linalg.norm(second), MIN_NORM))
