"""Are probabilities honest? Of what was called 80 % sure, 80 % should be right."""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.data import plots
from pipeline.metrics.metrics import Metrics, mean

BINS = 10
DOT_AREAS = (20, 320)
"""Square points of a dot without frames and of the one with the most."""


def reliability_metrics(
    name: str, probability: Float[np.ndarray, "frame"], right: Bool[np.ndarray, "frame"]
) -> Metrics:
    """Return the mean confidence, its expected calibration error over ten equal bins, and the curve as a
    chart.

    Frames without a probability do not count.
    Expected calibration error: Guo et al. 2017, "On Calibration of Modern Neural Networks".
    """
    metrics, known = Metrics(), np.isfinite(probability)
    probability, right = probability[known], right[known]
    claimed, met, count = _curve(probability, right)
    metrics.put(f"{name}/confidence_mean", mean(probability))
    error = float((count * np.abs(claimed - met)).sum() / count.sum()) if count.sum() else np.nan
    metrics.put(f"{name}/calibration_error", error)
    if count.sum():
        caption = (
            f"{name.replace('/agent', ' of the animal')}: share that was right by confidence; area: frames"
        )
        metrics.charts[caption] = _drawn(claimed, met, count)
    return metrics


def _curve(
    probability: Float[np.ndarray, "frame"], right: Bool[np.ndarray, "frame"]
) -> tuple[Float[np.ndarray, "bin"], Float[np.ndarray, "bin"], Int[np.ndarray, "bin"]]:
    """Return per bin the mean probability, the share that was right, and the number of frames."""
    index = np.clip((probability * BINS).astype(int), 0, BINS - 1)
    count = np.bincount(index, minlength=BINS)
    safe = np.maximum(count, 1)
    return np.bincount(index, probability, BINS) / safe, np.bincount(index, right, BINS) / safe, count


def _drawn(
    claimed: Float[np.ndarray, "bin"], met: Float[np.ndarray, "bin"], count: Int[np.ndarray, "bin"]
) -> UInt8[np.ndarray, "height width 3"]:
    figure, axes = plots.panels(1, 1, width_in=4, height_in=4)
    axis, filled = axes[0, 0], count > 0
    axis.plot((0, 1), (0, 1), color=plots.GREY, linewidth=1)
    area = np.interp(count[filled] / count.max(), (0, 1), DOT_AREAS)
    axis.scatter(claimed[filled], met[filled], s=area, color=plots.BLUE, clip_on=False, zorder=3)
    axis.set(xlim=(0, 1), ylim=(0, 1), xlabel="confidence", ylabel="share that was right", aspect="equal")
    return plots.pixels(figure)
