"""The figures of long-term motion against their bars."""

from collections.abc import Mapping
from typing import Literal

from pipeline.data.qa import Check
from stages.tabulate_longterm.methods import WITHOUT_SCENE

BASELINES = ("base", "route_cvae", "nearest")
OPTIMIZED, SAMPLES, MINUTES = "longterm/ours_opt", "longterm_samples", "longterm_minutes"
BARS: tuple[tuple[str, str | tuple[str, str], str, float, Literal["lower", "higher"]], ...] = (
    ("non-collision, optimized", f"{OPTIMIZED}/non_collision", "share", 0.995, "higher"),
    ("contact, optimized", f"{OPTIMIZED}/contact", "share", 0.97, "higher"),
    ("foot slide, optimized", f"{OPTIMIZED}/slide_m_s", "m/s", 0.01, "lower"),
    ("MPVPE, optimized against not",
        (f"{OPTIMIZED}/mpvpe_mm", "longterm/ours_same/mpvpe_mm"), "", 1.2, "lower"),
    ("distance of the ends from the given bodies, optimized",
        f"{OPTIMIZED}/end_v2v_share", "of body length", 0.006, "lower"),
    ("neighbor v2v where two motions join, beyond their own, optimized",
        f"{OPTIMIZED}/seam_share", "of body length", 0.006, "lower"),
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
)  # fmt: skip
"""Name, metric or pair of metrics, unit, bar, and direction of improvement of each check."""


def checks(figures: Mapping[str, float | None]) -> list[Check]:
    """Check the figures against the bars of long-term motion; a pair of metrics by its ratio."""

    def of(metric: str | tuple[str, str]) -> float | None:
        if isinstance(metric, str):
            return figures.get(metric)
        above, below = (figures.get(name) for name in metric)
        return None if above is None or not below else above / below

    ours = "longterm/ours/mpjpe_mm"
    compared = [
        (f"MPJPE against {baseline}", (ours, f"longterm/{baseline}/mpjpe_mm")) for baseline in BASELINES
    ]
    for name, blind in WITHOUT_SCENE.items():
        both = (f"longterm/{name}/translation", f"longterm/{blind}/translation")
        compared.append((f"translation against blind to the scene: {name}", both))
    return [
        *(Check(name, of(metrics), "", 1.0) for name, metrics in compared),
        *(Check(name, of(metric), unit, warn, better=better) for name, metric, unit, warn, better in BARS),
    ]
