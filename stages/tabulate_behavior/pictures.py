"""What the quality page of the tables shows: learning curves, and whether ours is ahead."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from pipeline.data import plots
from pipeline.data.qa import Check, Picture

TERMS = ("goal", "path", "body")
PLATEAU_SLOPE = 0.05


def pictures(curves: Mapping[str, Mapping[str, Float[np.ndarray, "seed step"]]]) -> list[Picture]:
    """Draw the losses of all trials: one panel per network, one color per method, one line per seed."""
    caption = (
        "Losses of all trials, smoothed over a fiftieth; the Gaussian's are likelihoods and lie elsewhere."
    )
    of_term = {term: {name: terms[term] for name, terms in curves.items() if term in terms} for term in TERMS}
    return [Picture("learning_curves", plots.loss_curves(of_term, width_in=12, log=False), caption)]


def checks(figures: Mapping[str, float | None], ours: str) -> list[Check]:
    """Judge whether ours is ahead of each method with goals of its own, and whether the curves lie flat."""
    ahead = [
        Check(f"{name.split('/')[1].replace('_', ' ')}, goal, upper end of the interval", value, "m", 0.0)
        for name, value in figures.items()
        if name.startswith(f"behavior/{ours}_minus_")
        and name.endswith("/goal_minde_m_ci95_high")
        and value is not None
        and figures[name.removesuffix("_ci95_high")] != 0  # a method that shares our goals
    ]
    falling = [
        value for name, value in figures.items() if name.endswith("_loss_still_falls") and value is not None
    ]
    return [
        *ahead,
        Check("losses still falling over the last tenth, at most", max(falling), "of itself", PLATEAU_SLOPE),
    ]
