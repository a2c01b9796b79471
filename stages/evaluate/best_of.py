"""How the error of the best of K samples falls with K, for each method: one sample says how good a guess is,
many how wide the distribution is.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, UInt8
from scipy.special import gammaln

from pipeline.data import plots

COUNTS = tuple(range(1, 17))
WORDS = {
    "ats": "ours",
    "location_prior": "location prior",
    "stand_still": "standing still",
    "constant_velocity": "constant velocity",
}
STYLES = (("#c8722b", "-", "o"), ("#2f6f9f", "--", "s"), ("#4c8067", "-.", "^"), ("#6d675e", ":", "D"))


def best_of(
    distance: Float[np.ndarray, "window sample"], counts: Sequence[int] = COUNTS
) -> Float[np.ndarray, "count"]:
    """Return the expected smallest of K distances, mean over windows.

    All ways to choose K of the drawn samples count alike: the i-th smallest of N is the best of C(N - 1 - i,
    K - 1) of them.
    """
    ordered, total = np.sort(distance, axis=1).mean(0), distance.shape[1]
    rank = np.arange(total)
    return np.array(
        [
            ordered @ np.exp(_log_choose(total - 1 - rank, k - 1) - _log_choose(np.array(total), k))
            for k in counts
        ]
    )


def drawn(
    distances: Mapping[str, Mapping[str, Float[np.ndarray, "window sample"]]],
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the curves of every method, one panel per figure; lines differ in dash and mark, not in colour
    alone.
    """
    names = list(dict.fromkeys(name for of_method in distances.values() for name in of_method))
    figure, grid = plots.panels(1, len(names), width_in=4.6 * len(names), height_in=3.4)
    for axes, name in zip(grid[0], names, strict=True):
        for (method, of_method), (color, dash, mark) in zip(distances.items(), STYLES, strict=False):
            if name in of_method:
                counts = [k for k in COUNTS if k <= of_method[name].shape[1]]
                mean = best_of(of_method[name], counts)
                axes.plot(
                    counts,
                    mean,
                    dash,
                    color=color,
                    marker=mark,
                    markersize=3.5,
                    label=WORDS.get(method, method),
                )
        axes.set(
            xlabel="samples K", ylabel=f"{name}, best of K (m)", xticks=(1, 2, 4, 8, 12, 16), ylim=(0, None)
        )
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=8)
    return plots.pixels(figure)


def _log_choose(total: np.ndarray, chosen: int) -> np.ndarray:
    """Return log C(total, chosen), -inf where there is no such choice."""
    possible = total >= chosen
    left = np.where(possible, total - chosen, 0)
    return np.where(
        possible, gammaln(np.maximum(total, 0) + 1) - gammaln(chosen + 1) - gammaln(left + 1), -np.inf
    )
