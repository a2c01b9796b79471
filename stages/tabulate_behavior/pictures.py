"""What the quality page of the tables shows: learning curves, and whether ours is ahead."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure

from pipeline import figures as drawing
from pipeline.qa import Check, Picture

TERMS = ("goal", "path", "body")
STILL_FALLING = 0.05


def pictures(curves: Mapping[str, Mapping[str, Float[np.ndarray, "seed step"]]]) -> list[Picture]:
    """Draw the losses of all trials."""
    caption = "Losses of all trials, smoothed over a fiftieth; the Gaussian's are likelihoods and lie elsewhere."
    return [Picture("learning_curves", learning_curves(curves), caption)]


def learning_curves(curves: Mapping[str, Mapping[str, Float[np.ndarray, "seed step"]]]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw one panel per network, one colour per method, one line per seed."""
    figure = Figure(figsize=(12, 4), dpi=80, layout="constrained")
    for axis, term in zip(figure.subplots(1, len(TERMS)), TERMS, strict=True):
        for number, (method, terms) in enumerate(curves.items()):
            for seed, loss in enumerate(terms.get(term, ())):
                width = max(len(loss) // 50, 1)
                smooth = np.convolve(loss, np.ones(width) / width, "valid")
                axis.plot(smooth, color=f"C{number % 10}", linewidth=0.8, label=method if seed == 0 else None)
        axis.set(title=term, xlabel="step")
    axis.legend(fontsize=7)
    return drawing.pixels(figure)


def checks(figures: Mapping[str, float | None], ours: str) -> list[Check]:
    """Judge whether ours is ahead of each method, and whether the curves lie flat."""
    ahead = [
        Check(f"{name.split('/')[1].replace('_', ' ')}, goal, upper end of the interval", value, "m", 0.0)
        for name, value in figures.items()
        if name.startswith(f"behavior/{ours}_minus_") and name.endswith("/goal_minde_m_ci95_high") and value is not None
    ]
    falling = [value for name, value in figures.items() if name.endswith("_loss_still_falls")]
    return [*ahead, Check("losses still falling over the last tenth, at most", max(falling), "of itself", STILL_FALLING)]
