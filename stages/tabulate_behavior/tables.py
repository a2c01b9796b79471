"""Means over windows and seeds, with intervals drawn over both: whole episodes, and whole trainings."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from pipeline.metrics.intervals import Interval, episodes
from stages.tabulate_behavior.reading import MethodScores

UNPREFIXED = "end_to_end"
"""Its figures carry no prefix: they are those of Table 4."""
CONTRASTS = (
    ("flees_seen_minus_true", "flees/seen", "flees/true"),
    ("flees_seen_minus_unseen", "flees/seen", "flees/unseen"),
    ("solid_minus_recorded", f"{UNPREFIXED}/solid", "recorded/solid"),
)
"""Figure, and the two scores whose difference it is, approach by approach or window by window."""

RESAMPLES = 2000
"""Bootstrap resamples: bounds of 95 % intervals vary by about 1 % of their width."""


def figures(
    found: Mapping[str, MethodScores], ours: str, *, seed: int, draws: int = RESAMPLES
) -> dict[str, float | None]:
    """Return all figures with their intervals, and those of the differences to ours where windows are the
    same.
    """
    table: dict[str, float | None] = {}
    for method, scores in found.items():
        for name, values in scores.values.items():
            window, frames = scores.windows_of(name), scores.past + scores.future
            table |= interval(values, window, frames, draws, seed).as_figures(
                f"behavior/{method}/{_figure(name)}"
            )
            rival = found[ours].values.get(name)
            if method != ours and rival is not None and np.array_equal(window, found[ours].windows_of(name)):
                if min(len(rival), len(values)) > 1:
                    both = min(len(rival), len(values))
                else:
                    both = max(len(rival), len(values))
                less = np.broadcast_to(rival[:both], (both, rival.shape[1])) - np.broadcast_to(
                    values[:both], (both, values.shape[1])
                )
                table |= interval(less, window, frames, draws, seed).as_figures(
                    f"behavior/{ours}_minus_{method}/{_figure(name)}"
                )
        _contrast(table, method, scores, draws, seed)
        table[f"behavior/{method}/seeds"] = len(next(iter(scores.values.values())))
    return table


def _contrast(
    table: dict[str, float | None], method: str, scores: MethodScores, draws: int, seed: int
) -> None:
    """Put what the bars ask of one method alone: flight against the animal's own and without the observer,
    and control.
    """
    for name, first, second in CONTRASTS:
        if first in scores.values and second in scores.values:
            less = scores.values[first] - scores.values[second]
            frames = scores.past + scores.future
            table |= interval(less, scores.windows_of(first), frames, draws, seed).as_figures(
                f"behavior/{method}/{name}"
            )
    fed, alone = (scores.values.get(f"{protocol}/path_minade_m") for protocol in ("truth_fed", UNPREFIXED))
    if fed is not None and alone is not None:
        table[f"behavior/{method}/path_minade_truth_fed_share"] = float(fed.mean() / alone.mean())


def interval(
    values: Float[np.ndarray, "seed window"],
    window: Int[np.ndarray, "window 2"],
    frames: int,
    draws: int,
    seed: int,
) -> Interval:
    """Resample seeds and episodes as long as a window of ``frames``, both with replacement, and return the
    mean with percentiles 2.5 and 97.5.

    The bounds of one episode alone are NaN.
    """
    rng = np.random.default_rng(seed)
    episode = episodes(window[:, 1], window[:, 0], frames)
    count = episode.max() + 1
    if count == 1:
        return Interval(float(values.mean()), np.nan, np.nan)
    total = np.stack([np.bincount(episode, row, count) for row in values])
    size = np.bincount(episode, minlength=count)
    means = np.empty(draws)
    for draw in range(draws):
        chosen, drawn = rng.integers(0, count, count), rng.integers(0, len(values), len(values))
        means[draw] = total[drawn][:, chosen].sum() / (size[chosen].sum() * len(values))
    return Interval(float(values.mean()), *(float(bound) for bound in np.percentile(means, (2.5, 97.5))))


def plateaus(curves: Mapping[str, Mapping[str, Float[np.ndarray, "seed step"]]]) -> dict[str, float]:
    """Return by how much of itself each loss still fell from its last but one tenth to its last: near 0 is a
    plateau.
    """
    table = {}
    for method, terms in curves.items():
        for name, loss in terms.items():
            loss = loss[:, ~np.isnan(loss).all(0)]
            tenth = max(loss.shape[1] // 10, 1)
            before, last = np.nanmean(loss[:, -2 * tenth : -tenth]), np.nanmean(loss[:, -tenth:])
            table[f"behavior/{method}/{name}_loss_last_tenth"] = float(last)
            table[f"behavior/{method}/{name}_loss_still_falls"] = float((before - last) / abs(before))
    return table


def _figure(name: str) -> str:
    return name.removeprefix(f"{UNPREFIXED}/").replace("/", "_")
