"""Quality page of a localizer: error histogram and worst held-out views."""

import numpy as np
from jaxtyping import UInt8

from pipeline.data import plots
from pipeline.data.qa import Check, Picture
from pipeline.localization.localizer import Localizer
from pipeline.localization.patches import Target
from stages.train_localizer.described_views import POSE_TOLERANCE, HeldOutErrors

EDGE_PX = 240
"""Longer side of a shown view."""


def report(held_out: HeldOutErrors, target: Target) -> dict[str, float | int]:
    """Return the held-out figures for ``localizer.json``; views without a pose count as failures."""
    rotation = np.nan_to_num(held_out.rotation_deg, nan=180.0)
    translation = np.nan_to_num(held_out.translation_m, nan=10.0)
    return {
        "views": len(held_out.views),
        "rotation_deg_median": float(np.median(rotation)),
        "translation_m_median": float(np.median(translation)),
        "good_share": float(held_out.good.mean()),
        "good_rotation_deg": POSE_TOLERANCE[target][0],
        "good_translation_m": POSE_TOLERANCE[target][1],
    }


def checks(held_out: HeldOutErrors, target: Target) -> list[Check]:
    """Return the quality checks of the held-out errors."""
    figures = report(held_out, target)
    rotation, translation = (2.0, 0.05) if target == "scene" else (20.0, 0.08)
    right = "right answers (within {:g} deg, {:g} m)".format(*POSE_TOLERANCE[target])
    angle, distance = figures["rotation_deg_median"], figures["translation_m_median"]
    return [
        Check("rotation, median of held-out renders", angle, "deg", rotation, 10 * rotation),
        Check("translation, median of held-out renders", distance, "m", translation, 10 * translation),
        Check(right, figures["good_share"], "share", 0.6, 0.1, "higher"),
    ]


def pictures(held_out: HeldOutErrors, localizer: Localizer, target: Target) -> list[Picture]:
    """Draw the error histogram and the eight worst views."""
    rotation = np.nan_to_num(held_out.rotation_deg, nan=180.0)
    worst = np.argsort(-rotation, kind="stable")[:8]
    probability = localizer.calibration.probability(held_out.inlier_ratio)
    tiles = [
        _tile(held_out.views[index].color, f"{rotation[index]:.1f} deg, p {probability[index]:.2f}")
        for index in worst
    ]
    series = {"rotation error [deg]": np.clip(rotation, 0.1, 180)}
    errors = plots.histograms(series, log=True, good_below=POSE_TOLERANCE[target][0])
    what = "The eight held-out renders with the largest error, and the probability they were given."
    return [
        Picture("errors", errors, "Rotation error of held-out renders, in degrees; green: counted as right."),
        Picture("worst", plots.grid(tiles, 4), what),
    ]


def _tile(picture: UInt8[np.ndarray, "height width 3"], text: str) -> UInt8[np.ndarray, "_ _ 3"]:
    """Resize a picture's longer side to 240 pixels and label it."""
    scale = EDGE_PX / max(picture.shape[:2])
    size = (round(picture.shape[0] * scale), round(picture.shape[1] * scale))
    return plots.labeled(plots.resized(picture, size), text)
