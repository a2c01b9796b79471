"""What stands in front of the map in the pictures of a turnaround, by their consistency with one another.

The animal rests, and so does its shadow: a point of the map has the same color in every picture that sees it.
A pixel shows the map if its color is likely among the colors that other pictures show there, where nothing
covers it, and else what stands in front (kernel density estimation as of Elgammal et al. 2000, over views in
place of times). What covers the map is found in rounds, beginning with what differs from the walk-through.
"""

from collections.abc import Sequence

import cv2
import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float

from pipeline.core.progress import track
from pipeline.geometry import subsampling
from pipeline.mapping.bundle_adjustment import MAD_TO_SIGMA
from pipeline.segmentation.grabcut import dilated
from stages.estimate_depth.foreground import ColorView, aligned_colors

REFERENCES, ROUNDS = 24, 3
"""Frames spread over the recording whose colors are compared, and rounds of segmenting these."""
FIRST_MARGIN_PX, MARGIN_PX = 6, 2
"""Margins of what covers the map in the first round and in later ones, pixels of small pictures."""
NOISE_STRIDE, NOISES, MIN_NOISE = 4, 2.0, 1.0
"""Stride of pixels and of references at which noise is measured; bandwidth of the kernel in deviations
of the noise, which misalignment adds to; least noise, 8-bit CIE Lab."""
BINS, BLUR_BINS = np.array([16, 24, 24]), 0.7
"""Bins of the histogram of what stands in front, along the axes of Lab, and its smoothing."""
LEAST_DENSITY, MAX_LOG_ODDS, MIN_SEEN = 1e-7, 6.0, 2
"""Density of colors that are neither; largest log-odds of a pixel; least pictures that see its point."""
RADIUS_PX, EDGE = 2, 0.1
"""Guided filter of log-odds: radius in pixels, standard deviation of color (0..1) below which it smooths."""
Mask = Bool[np.ndarray, "height width"]
Lab = Float[np.ndarray, "*shape 3"]


def segment(shown: Sequence[ColorView], differing: Sequence[Mask]) -> list[Mask]:
    """Return what stands in front of the map in every view; ``differing``: a first guess for `references`."""
    chosen, covered = references(len(shown)), list(differing)
    bandwidth = NOISES * _noise(shown, chosen)
    for number in range(ROUNDS + 1):
        pairs = list(zip(chosen, covered, strict=True))
        own = _histogram(np.concatenate([shown[at].lab[~dilated(~mask, MARGIN_PX)] for at, mask in pairs]))
        margin_px = MARGIN_PX if number else FIRST_MARGIN_PX
        blocked = {frame: dilated(mask, margin_px) for frame, mask in pairs}
        frames = track(chosen if number < ROUNDS else range(len(shown)), "comparing views")
        covered = [_in_front(shown, frame, blocked, own, bandwidth) for frame in frames]
    return covered


def references(count: int) -> list[int]:
    """Return the frames that each frame is compared with."""
    return subsampling.evenly(count, REFERENCES).tolist()


def _in_front(shown, frame: int, blocked: dict[int, Mask], own, bandwidth: Lab) -> Mask:
    """Return where a color is more likely of what stands in front than of the map at that point."""
    target, scale = shown[frame], float(np.prod(bandwidth)) * (2 * np.pi) ** (3 / 2)
    density, seen = np.zeros(target.view.gray.shape, np.float32), np.zeros(target.view.gray.shape, np.float32)
    for other, cover in blocked.items():
        if other == frame:
            continue
        there, known, color = aligned_colors(target, shown[other])
        at = there - 0.5
        known &= cv2.remap(cover.astype(np.uint8), at[..., 0], at[..., 1], cv2.INTER_NEAREST) == 0
        distance = (((color - target.lab) / bandwidth) ** 2).sum(-1)
        density += np.exp(-distance / 2) * known
        seen += known
    mapped = density / np.maximum(seen, 1) / scale
    log_odds = np.log(own[_bin(target.lab)] + LEAST_DENSITY) - np.log(mapped + LEAST_DENSITY)
    log_odds = np.where(seen < MIN_SEEN, 0, np.clip(log_odds, -MAX_LOG_ODDS, MAX_LOG_ODDS)).astype(np.float32)
    guide = target.color.astype(np.float32) / 255
    return cv2.ximgproc.guidedFilter(guide, log_odds, RADIUS_PX, EDGE**2) > 0


def _noise(shown: Sequence[ColorView], chosen: Sequence[int]) -> Float[np.ndarray, "3"]:
    """Return the standard deviation (robust) of colors around the median of the other pictures."""
    off, step = [], np.s_[::NOISE_STRIDE, ::NOISE_STRIDE]
    for frame in chosen[::NOISE_STRIDE]:
        seen = [aligned_colors(shown[frame], shown[other])[1:] for other in chosen if other != frame]
        color = np.stack([np.where(known[step][..., None], color[step], np.nan) for known, color in seen])
        often = np.isfinite(color[..., 0]).sum(0) >= MIN_SEEN
        off.append(shown[frame].lab[step][often] - np.nanmedian(color[:, often], axis=0))
    sigma = MAD_TO_SIGMA * np.median(np.abs(np.concatenate(off)), axis=0)
    return np.fmax(sigma, MIN_NOISE).astype(np.float32)


def _histogram(lab: Float[np.ndarray, "pixel 3"]) -> Float[np.ndarray, "light a b"]:
    """Return the density of colors, per unit of Lab."""
    counts = np.zeros(BINS, np.float32)
    np.add.at(counts, _bin(lab), 1.0)
    smooth = scipy.ndimage.gaussian_filter(counts, BLUR_BINS)
    return smooth / max(len(lab), 1) * float(np.prod(BINS / 255))


def _bin(lab: Lab) -> tuple[np.ndarray, ...]:
    at = np.clip(lab / 255 * BINS, 0, BINS - 1).astype(int)
    return at[..., 0], at[..., 1], at[..., 2]
