"""Means over windows and seeds, with bootstrap intervals that resample episodes and trainings."""

from collections.abc import Mapping
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from pipeline.metrics.intervals import Interval, bootstrapped, episodes
from stages.tabulate_behavior.reading import MethodScores

UNPREFIXED = "end_to_end"
"""Protocol of Table 4, whose figures have no prefix."""
CONTRASTS = (
    ("flees_seen_minus_true", "flees/seen", "flees/true"),
    ("flees_seen_minus_unseen", "flees/seen", "flees/unseen"),
    ("solid_minus_recorded", f"{UNPREFIXED}/solid", "recorded/solid"),
)
"""Figures, each the paired difference of two scores per approach or window."""


def figures(found: Mapping[str, MethodScores], ours: str, *, seed: int) -> dict[str, float | None]:
    """Return all figures with intervals, and paired differences to ours where the windows are the same."""
    table: dict[str, float | None] = {}
    for method, scores in found.items():
        for name, values in scores.values.items():
            window, frames = scores.windows_of(name), scores.past + scores.future
            figure = name.removeprefix(f"{UNPREFIXED}/").replace("/", "_")
            interval_of = partial(interval, window=window, frames=frames, seed=seed)
            table |= interval_of(values).as_figures(f"behavior/{method}/{figure}")
            baseline = found[ours].values.get(name)
            if (
                method != ours
                and baseline is not None
                and np.array_equal(window, found[ours].windows_of(name))
            ):
                both = min(len(baseline), len(values))
                paired = slice(both if both > 1 else None)  # one seed alone is paired with all others
                difference = interval_of(baseline[paired] - values[paired])
                table |= difference.as_figures(f"behavior/{ours}_minus_{method}/{figure}")
        _add_contrasts(table, method, scores, seed)
        table[f"behavior/{method}/seeds"] = len(next(iter(scores.values.values())))
    return table


def _add_contrasts(table: dict[str, float | None], method: str, scores: MethodScores, seed: int) -> None:
    """Add the contrasts within one method."""
    for name, first, second in CONTRASTS:
        if first in scores.values and second in scores.values:
            difference, frames = scores.values[first] - scores.values[second], scores.past + scores.future
            found = interval(difference, scores.windows_of(first), frames, seed)
            table |= found.as_figures(f"behavior/{method}/{name}")


def interval(
    values: Float[np.ndarray, "seed window"], window: Int[np.ndarray, "window 2"], frames: int, seed: int
) -> Interval:
    """Return the mean and its interval over seeds and episodes of ``frames`` frames; NaN of one episode."""
    return bootstrapped(values, episodes(window[:, 1], window[:, 0], frames), np.random.default_rng(seed))


def plateaus(curves: Mapping[str, Mapping[str, Float[np.ndarray, "seed step"]]]) -> dict[str, float]:
    """Return the last tenth of each loss and its relative decrease since the tenth before; 0 is a plateau."""
    table = {}
    for method, terms in curves.items():
        for name, loss in terms.items():
            loss = loss[:, ~np.isnan(loss).all(0)]
            tenth = max(loss.shape[1] // 10, 1)
            before, last = np.nanmean(loss[:, -2 * tenth : -tenth]), np.nanmean(loss[:, -tenth:])
            table[f"behavior/{method}/{name}_loss_last_tenth"] = float(last)
            table[f"behavior/{method}/{name}_loss_still_falls"] = float((before - last) / abs(before))
    return table
