"""Calibration of confidences: reliability curve and expected calibration error."""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.data import plots
from pipeline.metrics.metrics import Metrics, mean

BINS = 10
DOT_AREAS = (20, 320)
"""Areas, in square points, of the dots with no and with the most frames."""


def reliability_metrics(
    name: str, probability: Float[np.ndarray, "frame"], right: Bool[np.ndarray, "frame"]
) -> Metrics:
    """Return mean confidence, expected calibration error (Guo et al. 2017) over ten bins, and a chart.

    Frames without a probability are ignored.
    """
    metrics = Metrics()
    confidence, accuracy, count = reliability_curve(probability, right)
    metrics.put(f"{name}/confidence_mean", mean(probability[np.isfinite(probability)]))
    error = float((count * np.abs(confidence - accuracy)).sum() / count.sum()) if count.sum() else np.nan
    metrics.put(f"{name}/calibration_error", error)
    if count.sum():
        caption = f"{name.replace('/agent', ' of the animal')}: share that was right by confidence"
        metrics.charts[f"{caption}; area: frames"] = _chart(confidence, accuracy, count)
    return metrics


def reliability_curve(
    probability: Float[np.ndarray, "frame"], right: Bool[np.ndarray, "frame"]
) -> tuple[Float[np.ndarray, "bin"], Float[np.ndarray, "bin"], Int[np.ndarray, "bin"]]:
    """Return mean confidence, share that was right (both 0..1, 0 without frames) and frames of ten bins.

    Frames without a probability are ignored.
    """
    known = np.isfinite(probability)
    probability, right = probability[known], right[known]
    index = np.clip((probability * BINS).astype(int), 0, BINS - 1)
    count = np.bincount(index, minlength=BINS)
    confidence, accuracy = (
        np.bincount(index, each, BINS) / np.maximum(count, 1) for each in (probability, right)
    )
    return confidence, accuracy, count


def _chart(
    confidence: Float[np.ndarray, "bin"], accuracy: Float[np.ndarray, "bin"], count: Int[np.ndarray, "bin"]
) -> UInt8[np.ndarray, "height width 3"]:
    figure, axes = plots.panels(1, 1, width_in=4, height_in=4)
    axis, filled = axes[0, 0], count > 0
    axis.plot((0, 1), (0, 1), color=plots.GRAY, linewidth=1)
    area = np.interp(count[filled] / count.max(), (0, 1), DOT_AREAS)
    axis.scatter(confidence[filled], accuracy[filled], s=area, color=plots.BLUE, clip_on=False, zorder=3)
    axis.set(xlim=(0, 1), ylim=(0, 1), xlabel="confidence", ylabel="share that was right", aspect="equal")
    return plots.pixels(figure)
