"""What the quality page of a localizer shows: the error histogram and the worst held-out views."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.models.localizer import Localizer
from pipeline.models.sight import Target
from pipeline.qa import Check, Picture
from pipeline.space import overview
from stages.train_localizer.describing import GOOD, HeldOut


def report(held: HeldOut, target: Target) -> dict[str, float | int]:
    """Return the held-out figures for ``localizer.json``; views without an answer count as failures."""
    rotation, translation = np.nan_to_num(held.rotation_deg, nan=180.0), np.nan_to_num(held.translation_m, nan=10.0)
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
    return [
        Check("rotation, median of held-out renders", figures["rotation_deg_median"], "deg", rotation, 10 * rotation),
        Check(
            "translation, median of held-out renders",
            figures["translation_m_median"],
            "m",
            translation,
            10 * translation,
        ),
        Check(
            "right answers (within {:g} deg, {:g} m)".format(*GOOD[target]),
            figures["good_share"],
            "share",
            0.6,
            0.1,
            "higher",
        ),
    ]


def pictures(held: HeldOut, localizer: Localizer) -> list[Picture]:
    """Draw the histogram and the worst eight."""
    rotation = np.nan_to_num(held.rotation_deg, nan=180.0)
    worst = np.argsort(-rotation, kind="stable")[:8]
    edge = 240
    tiles = [
        _label(
            _square(held.views[index].color, edge),
            f"{rotation[index]:.1f} deg, p {float(localizer.calibration.probability(held.inlier_ratio[index])):.2f}",
        )
        for index in worst
    ]
    return [
        Picture(
            "errors",
            histogram(rotation),
            "Rotation error of held-out renders in degrees (log scale from 0.1 to 180); green: counted as right.",
        ),
        Picture(
            "worst",
            overview.tile(tiles, 4),
            "The eight held-out renders with the largest error, and the probability they were given.",
        ),
    ]


def histogram(rotation_deg: Float[np.ndarray, "view"]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a histogram of errors on a logarithmic axis."""
    edges = np.geomspace(0.1, 180, 31)
    counts, _ = np.histogram(np.clip(rotation_deg, 0.1, 179.9), edges)
    image = np.full((200, 480, 3), 255, np.uint8)
    for index, count in enumerate(counts):
        top = 180 - int(160 * count / max(counts.max(), 1))
        color = (70, 160, 90) if edges[index] < 2 else (200, 130, 60)
        cv2.rectangle(image, (index * 16 + 2, top), (index * 16 + 14, 180), color, -1)
    for value in (0.1, 1, 10, 100):
        column = int(480 * np.log(value / 0.1) / np.log(1800))
        cv2.putText(image, f"{value:g}", (column + 2, 196), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (60, 60, 60), 1, cv2.LINE_AA)
    return image


def _square(picture, edge):
    scale = edge / max(picture.shape[:2])
    resized = cv2.resize(picture, (round(picture.shape[1] * scale), round(picture.shape[0] * scale)), interpolation=cv2.INTER_LINEAR)
    canvas = np.full((edge, edge, 3), overview.BACKGROUND, np.uint8)
    canvas[: resized.shape[0], : resized.shape[1]] = resized
    return canvas


def _label(picture, text):
    picture[-20:] = overview.BACKGROUND
    place = (4, picture.shape[0] - 6)
    return cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (20, 20, 20), 1, cv2.LINE_AA)
