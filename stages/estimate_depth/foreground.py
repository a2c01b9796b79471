"""What stands before the room: pixels that differ from what other pictures show of the same place.

The room's surface is known, so pictures of the walk-through, in which nothing moves, and of other times of
the recording are brought into each frame's camera. A pixel is foreground where it differs from the
walk-through and from some of the recording's other times: what people moved since then stays alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stages.estimate_depth import views
from stages.estimate_depth.views import View

OTHER_TIMES = 24
"""Frames spread over the recording that each one is compared with, and of them so many that see a place."""
APART_S = 0.7
"""Frames nearer in time than this show the animal at the same place, seconds."""
SLACK_PX, SOFTNESS_PX = 2, 0.8
"""Pixels of the small picture by which places may be off, and deviation of the blur that hides less."""
DIFFERS, MAY_DIFFER = 22.0, 9.0
"""Differences of colours (CIE Lab, 0 to 255 each, summed) beyond the slack that are no noise, and that are
none beside such."""
MIN_SEEN, WALK_SHARE, MIN_TIMES, TIMES_SHARE = 2, 0.5, 2, 0.1
"""Pictures of other times that must have seen a place, share of the walk-through's pictures that must differ,
and number and share of those of other times: an animal may rest at one place for most of a recording."""
OPENED, CLOSED = np.ones((3, 3), np.uint8), np.ones((7, 7), np.uint8)
"""Specks that are no animal, and gaps that belong to one: its stripes may look like the floor."""


@dataclass(frozen=True)
class ColorView:
    """A view with its colours, softened so that places may be off a little."""

    view: View
    lab: Float[np.ndarray, "height width 3"]


def color_view(color: UInt8[np.ndarray, "height width 3"], view: View) -> ColorView:
    """Add colours to a view."""
    small = cv2.resize(color, view.gray.shape[::-1], interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB).astype(np.float32)
    return ColorView(view, cv2.GaussianBlur(lab, (3, 3), SOFTNESS_PX))


def difference(
    target: ColorView, source: ColorView
) -> tuple[Float[np.ndarray, "height width"], Bool[np.ndarray, "height width"]]:
    """Return by how much, beyond the slack, pixels differ from a source, and where it shows their places."""
    warped = views.warp(target.view, source.view)
    shown = cv2.remap(source.lab, warped.there[..., 0] - 0.5, warped.there[..., 1] - 0.5, cv2.INTER_LINEAR)
    known = warped.known
    if known.sum() < MIN_SEEN:
        return np.zeros(known.shape, np.float32), np.zeros(known.shape, bool)
    # exposure and white balance change between recordings
    shown = shown + np.median((target.lab - shown)[known], axis=0)
    shown = np.where(known[..., None], shown, target.lab)
    around = np.ones((2 * SLACK_PX + 1,) * 2, np.uint8)
    low, high = cv2.erode(shown, around), cv2.dilate(shown, around)
    beyond = np.maximum(np.maximum(target.lab - high, low - target.lab), 0).sum(-1)
    return beyond, cv2.erode(known.astype(np.uint8), around) > 0


def foreground(
    target: ColorView, walk: Sequence[ColorView], times: Sequence[ColorView]
) -> Bool[np.ndarray, "height width"]:
    """Return which pixels stand before the room."""
    by_walk, by_times = ([difference(target, source) for source in sources] for sources in (walk, times))
    sure, weak = (_differing(by_walk, by_times, limit) for limit in (DIFFERS, MAY_DIFFER))
    sure = cv2.morphologyEx(sure.astype(np.uint8), cv2.MORPH_OPEN, OPENED)
    weak = cv2.morphologyEx((weak | (sure > 0)).astype(np.uint8), cv2.MORPH_OPEN, OPENED)
    _, part = cv2.connectedComponents(weak, connectivity=8)
    grown = np.isin(part, np.unique(part[(sure > 0) & (part > 0)]))
    return cv2.morphologyEx(grown.astype(np.uint8), cv2.MORPH_CLOSE, CLOSED) > 0


def _differing(by_walk, by_times, limit: float) -> Bool[np.ndarray, "height width"]:
    """Return where the walk-through's pictures and enough of the other times' differ by more than a limit."""
    walked, seen_walk = _votes(by_walk, limit)
    timed, seen = _votes(by_times, limit)
    unlike_walk = (seen_walk == 0) | (walked >= WALK_SHARE * seen_walk)
    enough = np.maximum(TIMES_SHARE * seen, np.minimum(MIN_TIMES, seen))
    unlike_times = (seen < MIN_SEEN) | (timed >= enough)
    return unlike_walk & unlike_times & ((seen_walk > 0) | (seen >= MIN_SEEN))


def _votes(compared, limit: float):
    """Count the pictures that differ, and those that see each pixel's place."""
    differing = sum(known & (beyond > limit) for beyond, known in compared)
    return differing, sum(known.astype(int) for _, known in compared)
