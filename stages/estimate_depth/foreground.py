"""Foreground segmentation: pixels that differ from other pictures of the same surface.

The room's surface is known, so pictures of the walk-through, in which nothing moves, and of other times of
the recording are warped into each frame's camera. A pixel is foreground if it differs from the walk-through
and from some other times of the recording; the latter excludes furniture moved since the walk-through.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.geometry import cameras, picture_fit
from pipeline.segmentation.appearance import Appearance, components
from pipeline.segmentation.grabcut import Region, dilated, outlined
from stages.estimate_depth import views
from stages.estimate_depth.views import View

OTHER_TIMES = 24
"""Frames spread over the recording that each frame is compared with."""
MIN_GAP_S = 0.7
"""Least time between compared frames, in which the animal moves on, seconds."""
SLACK_PX, SOFTNESS_PX = 2, 0.8
"""Tolerated misalignment and standard deviation of the blur, pixels of the small picture."""
HIGH_THRESHOLD, LOW_THRESHOLD = 22.0, 9.0
"""Hysteresis thresholds of color difference (sum over 8-bit CIE Lab channels)."""
MIN_SEEN, WALK_SHARE, MIN_TIMES, TIMES_SHARE = 2, 0.5, 2, 0.1
"""Least pictures of other times that see a pixel; share of walk-through pictures that must differ; least
number and share of other times that must: an animal may rest at one place for most of a recording."""
OPENING, CLOSING = np.ones((3, 3), np.uint8), np.ones((7, 7), np.uint8)
"""Kernels against specks, and against gaps in the animal, whose stripes may look like the floor."""
REACH_PX = 12
"""The animal is at most this far from foreground, pixels of small pictures: parts of it resemble the room."""
MOST_PARTS = 4
"""Most parts of a picture that may be the animal."""


@dataclass(frozen=True)
class ColorView:
    """A view with its colors."""

    view: View
    color: UInt8[np.ndarray, "height width 3"]
    lab: Float[np.ndarray, "height width 3"]
    """CIE Lab, blurred against misalignment."""


def color_view(color: UInt8[np.ndarray, "height width 3"], view: View) -> ColorView:
    """Add colors to a view."""
    small = cv2.resize(color, view.gray.shape[::-1], interpolation=cv2.INTER_AREA)
    lab = picture_fit.lab(small)
    return ColorView(view, small, cv2.GaussianBlur(lab, (3, 3), SOFTNESS_PX))


def aligned_colors(
    target: ColorView, source: ColorView
) -> tuple[Float[np.ndarray, "height width 2"], Region, Float[np.ndarray, "height width 3"]]:
    """Return where a source shows a target's points of the map, whether it sees them, and its colors."""
    there, known = views.warp(target.view, source.view)
    color = cameras.sample_bilinear(source.lab, there).astype(np.float32)
    if known.any():  # exposure and white balance change
        color += np.median((target.lab - color)[known], axis=0)
    return there, known, color


def difference(
    target: ColorView, source: ColorView
) -> tuple[Float[np.ndarray, "height width"], Bool[np.ndarray, "height width"]]:
    """Return the color difference to a source, beyond the slack, and where the source sees the surface."""
    _, known, shown = aligned_colors(target, source)
    shown = np.where(known[..., None], shown, target.lab)
    around = np.ones((2 * SLACK_PX + 1,) * 2, np.uint8)
    low, high = cv2.erode(shown, around), cv2.dilate(shown, around)
    beyond = np.maximum(np.maximum(target.lab - high, low - target.lab), 0).sum(-1)
    return beyond, cv2.erode(known.astype(np.uint8), around) > 0


def foreground(
    target: ColorView, walk: Sequence[ColorView], times: Sequence[ColorView]
) -> Bool[np.ndarray, "height width"]:
    """Segment the foreground by hysteresis thresholding and morphology; none without any source."""
    if not (walk or times):
        return np.zeros(target.view.gray.shape, bool)
    both = [[difference(target, source) for source in sources] for sources in (walk, times)]
    sure, weak = (_differing(both, limit) for limit in (HIGH_THRESHOLD, LOW_THRESHOLD))
    sure = cv2.morphologyEx(sure.astype(np.uint8), cv2.MORPH_OPEN, OPENING)
    weak = cv2.morphologyEx((weak | (sure > 0)).astype(np.uint8), cv2.MORPH_OPEN, OPENING)
    _, part = cv2.connectedComponents(weak, connectivity=8)
    grown = np.isin(part, np.unique(part[(sure > 0) & (part > 0)]))
    return cv2.morphologyEx(grown.astype(np.uint8), cv2.MORPH_CLOSE, CLOSING) > 0


def recognize(network: Appearance, target: ColorView, in_front: Region) -> list[tuple[Region, float]]:
    """Return the parts recognized near foreground (as the animal's shadow is), surest first, with their
    evidence: the sum of log-odds.
    """
    log_odds, found = network.log_odds(target.color), []
    recognized = (log_odds > 0) & dilated(in_front, REACH_PX)
    for part, evidence in components(recognized, log_odds, MOST_PARTS):
        rng = np.random.default_rng(0)  # the same for every part, so that no mask depends on the others
        found.append((outlined(target.color, part, log_odds, rng), evidence))
    return found


def _differing(both, limit: float) -> Bool[np.ndarray, "height width"]:
    """Return where enough pictures of the walk-through and of other times differ by more than a limit."""
    walk_votes, time_votes = (sum(known & (beyond > limit) for beyond, known in each) for each in both)
    seen_walk, seen = (sum(known.astype(int) for _, known in each) for each in both)
    unlike_walk = (seen_walk == 0) | (walk_votes >= WALK_SHARE * seen_walk)
    enough = np.maximum(TIMES_SHARE * seen, np.minimum(MIN_TIMES, seen))
    unlike_times = (seen < MIN_SEEN) | (time_votes >= enough)
    return unlike_walk & unlike_times & ((seen_walk > 0) | (seen >= MIN_SEEN))
