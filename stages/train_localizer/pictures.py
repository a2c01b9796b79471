"""What the quality page of a localizer shows: the error histogram and the worst held-out views."""

import numpy as np
from jaxtyping import UInt8

from pipeline.data import plots
from pipeline.data.qa import Check, Picture
from pipeline.localization.localizer import Localizer
from pipeline.localization.patches import Target
from stages.train_localizer.describing import GOOD, HeldOut

EDGE_PX = 240
"""Longer side of a shown view."""


def report(held: HeldOut, target: Target) -> dict[str, float | int]:
    """Return the held-out figures for ``localizer.json``; views without an answer count as failures."""
    rotation = np.nan_to_num(held.rotation_deg, nan=180.0)
    translation = np.nan_to_num(held.translation_m, nan=10.0)
    return {
        "views": len(held.views),
        "rotation_deg_median": float(np.median(rotation)),
        "translation_m_median": float(np.median(translation)),
        "good_share": float(held.good.mean()),
        "good_rotation_deg": GOOD[target][0],
        "good_translation_m": GOOD[target][1],
    }


def checks(held: HeldOut, target: Target) -> list[Check]:
    """Judge the held-out figures."""
    figures = report(held, target)
    rotation, translation = (2.0, 0.05) if target == "scene" else (20.0, 0.08)
    right = "right answers (within {:g} deg, {:g} m)".format(*GOOD[target])
    turned, moved = figures["rotation_deg_median"], figures["translation_m_median"]
    return [
        Check("rotation, median of held-out renders", turned, "deg", rotation, 10 * rotation),
        Check("translation, median of held-out renders", moved, "m", translation, 10 * translation),
        Check(right, figures["good_share"], "share", 0.6, 0.1, "higher"),
    ]


def pictures(held: HeldOut, localizer: Localizer, target: Target) -> list[Picture]:
    """Draw the histogram and the worst eight."""
    rotation = np.nan_to_num(held.rotation_deg, nan=180.0)
    worst = np.argsort(-rotation, kind="stable")[:8]
    probability = localizer.calibration.probability(held.inlier_ratio)
    tiles = [
        _shown(held.views[index].color, f"{rotation[index]:.1f} deg, p {probability[index]:.2f}")
        for index in worst
    ]
    shown = {"rotation error [deg]": np.clip(rotation, 0.1, 180)}
    errors = plots.histograms(shown, log=True, good_below=GOOD[target][0])
    what = "The eight held-out renders with the largest error, and the probability they were given."
    return [
        Picture("errors", errors, "Rotation error of held-out renders, in degrees; green: counted as right."),
        Picture("worst", plots.grid(tiles, 4), what),
    ]


def _shown(picture: UInt8[np.ndarray, "height width 3"], text: str) -> UInt8[np.ndarray, "_ _ 3"]:
    """Bring a picture's longer side to 240 pixels and write below it."""
    scale = EDGE_PX / max(picture.shape[:2])
    size = (round(picture.shape[0] * scale), round(picture.shape[1] * scale))
    return plots.labelled(plots.resized(picture, size), text)
