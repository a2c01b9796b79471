"""Are probabilities honest? Of what was called 80 % sure, 80 % should be right."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stages.evaluate.figures import Figures

BINS = 10


def reliability_figures(name: str, probability: Float[np.ndarray, "frame"], right: Bool[np.ndarray, "frame"]) -> Figures:
    """Return the expected calibration error over equal bins, how much is claimed and how well it ranks; and the curve."""
    figures = Figures()
    claimed, met, count = _curve(probability, right)
    figures.put(f"{name}/confidence_mean", float(probability.mean()) if len(probability) else np.nan)
    figures.put(f"{name}/calibration_error", float((count * np.abs(claimed - met)).sum() / count.sum()) if count.sum() else np.nan)
    if count.sum():
        figures.charts[f"{name}: share of right poses (up) against the probability given to them (right); area: frames"] = _drawn(
            claimed, met, count
        )
    return figures


def _curve(probability, right):
    """Return per bin the mean probability, the share that was right and the frames; empty bins have no frames."""
    index = np.clip((probability * BINS).astype(int), 0, BINS - 1)
    count = np.bincount(index, minlength=BINS)
    safe = np.maximum(count, 1)
    return np.bincount(index, probability, BINS) / safe, np.bincount(index, right, BINS) / safe, count


def _drawn(claimed, met, count, edge_px: int = 320) -> UInt8[np.ndarray, "height width 3"]:
    image, margin = np.full((edge_px, edge_px, 3), 252, np.uint8), 24
    span = edge_px - 2 * margin

    def place(x, y):
        return round(margin + span * x), round(edge_px - margin - span * y)

    cv2.rectangle(image, place(0, 0), place(1, 1), (190, 190, 190), 1)
    cv2.line(image, place(0, 0), place(1, 1), (190, 190, 190), 1, cv2.LINE_AA)
    for x, y, frames in zip(claimed, met, count, strict=True):
        if frames:
            radius = 3 + round(14 * np.sqrt(frames / count.max()))
            cv2.circle(image, place(x, y), radius, (50, 110, 210), -1, cv2.LINE_AA)
    for text, at in (("0", place(-0.05, -0.06)), ("1", place(0.99, -0.06)), ("1", place(-0.05, 0.98))):
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (60, 60, 60), 1, cv2.LINE_AA)
    return image
