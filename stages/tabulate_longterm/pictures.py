"""What the quality page of the tables shows: errors of all methods, and the figures against their bars."""

from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from pipeline.data import plots
from pipeline.data.qa import Check, Picture
from pipeline.metrics.intervals import names_of
from stages.tabulate_longterm.methods import WITHOUT_SCENE

QUALITY = {
    "good": "ours ahead of every rival, and physical after the optimisation at little more error",
    "bad": "a rival ahead, feet that slide, bodies inside furniture",
}
RIVALS = ("base", "route_cvae", "nearest")
OPTIMIZED, SAMPLES, MINUTES = "longterm/ours_opt", "longterm_samples", "longterm_minutes"
BARS: tuple[tuple[str, str | tuple[str, str], str, float, Literal["lower", "higher"]], ...] = (
    ("non-collision, optimised", f"{OPTIMIZED}/non_collision", "share", 0.995, "higher"),
    ("contact, optimised", f"{OPTIMIZED}/contact", "share", 0.97, "higher"),
    ("foot slide, optimised", f"{OPTIMIZED}/slide_m_s", "m/s", 0.01, "lower"),
    (
        "MPVPE, optimised against not",
        (f"{OPTIMIZED}/mpvpe_mm", "longterm/ours_same/mpvpe_mm"),
        "",
        1.2,
        "lower",
    ),
    (
        "distance of the ends from the given bodies, optimised",
        f"{OPTIMIZED}/end_v2v_share",
        "of body length",
        0.006,
        "lower",
    ),
    (
        "neighbour v2v where two motions join, beyond their own, optimised",
        f"{OPTIMIZED}/seam_share",
        "of body length",
        0.006,
        "lower",
    ),
    *(
        (f"samples: {words} left", (f"{SAMPLES}/{name}", f"{SAMPLES}/{before}"), "", warn, "lower")
        for words, name, before, warn in (
            ("penetration", "penetration_m", "penetration_before_m", 0.5),
            ("slide", "slide_m_s", "slide_before_m_s", 0.5),
            ("goal error", "goal_error_m", "goal_error_before_m", 1.03),
            ("path error", "path_error_m", "path_error_before_m", 1.03),
        )
    ),
    ("minutes: largest seam", f"{MINUTES}/largest_seam_m", "m", 0.02, "lower"),
    ("minutes: outside of the room", f"{MINUTES}/outside_room_m", "m", 0.01, "lower"),
    ("minutes: deepest vertex inside something", f"{MINUTES}/deepest_m", "m", 0.02, "lower"),
)
"""What is judged: name, metric or pair of metrics, unit, the bar, and which way is better."""


def checks(figures: Mapping[str, float | None]) -> list[Check]:
    """Judge the figures by the bars of long-term motion; a pair of metrics is judged by its ratio."""

    def of(metric: str | tuple[str, str]) -> float | None:
        if isinstance(metric, str):
            return figures.get(metric)
        above, below = (figures.get(name) for name in metric)
        return None if above is None or not below else above / below

    compared = [
        (f"MPJPE against {rival}", ("longterm/ours/mpjpe_mm", f"longterm/{rival}/mpjpe_mm"))
        for rival in RIVALS
    ] + [
        (
            f"translation against blind to the scene: {name}",
            (f"longterm/{name}/translation", f"longterm/{blind}/translation"),
        )
        for name, blind in WITHOUT_SCENE.items()
    ]
    return [
        *(Check(name, of(metrics), "", 1.0) for name, metrics in compared),
        *(Check(name, of(metric), unit, warn, better=better) for name, metric, unit, warn, better in BARS),
    ]


def pictures(figures: Mapping[str, float | None]) -> list[Picture]:
    """Draw MPJPE of all methods with their intervals."""
    caption = "MPJPE of two-second motions between given bodies: mean and 95 % interval over episodes."
    return [Picture("mpjpe", bars(figures), caption)]


def bars(figures: Mapping[str, float | None]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw one row of bars per source of motion."""
    figure, axes = plots.panels(1, 2, width_in=11, height_in=4)
    for axis, prefix in zip(axes[0], ("longterm", "longterm_recorded"), strict=True):
        ending = "/mpjpe_mm"
        names = [
            name.split("/")[1] for name in figures if name.startswith(f"{prefix}/") and name.endswith(ending)
        ]
        names = [
            name for name in names if figures[f"{prefix}/{name}{ending}"] is not None and name != "truth"
        ]
        mean = np.array([figures[f"{prefix}/{name}{ending}"] for name in names])
        ends = np.array(
            [[figures[each] for each in names_of(f"{prefix}/{name}{ending}")[1:]] for name in names], float
        ).reshape(-1, 2)
        off = np.abs(ends - mean[:, None]).T
        axis.barh(
            names,
            mean,
            xerr=off,
            color=[plots.ORANGE if name.startswith("ours") else plots.BLUE for name in names],
        )
        axis.set(title=prefix, xlabel="mm")
        axis.invert_yaxis()
    return plots.pixels(figure)
