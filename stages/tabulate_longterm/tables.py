"""Figures with confidence intervals, and the tables as text."""

import re
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from pipeline.metrics.intervals import aligned, bootstrapped, formatted_interval
from stages.tabulate_longterm.scores import MEDIANS, METRICS

TABLE_1 = ("translation", "orientation", "pose", "mpjpe_mm", "mpvpe_mm")
TABLE_2 = ("non_collision", "contact", "penetration_mm", "slide_m_s", "planted", "min_slide_m_s")
LENGTHS = ("mpvpe_mm", "non_collision", "contact", "slide_m_s", "planted", "min_slide_m_s", "seam_worst_mm")
TABLE_4 = ("end_v2v_share", "neighbor_v2v_mm", "neighbor_v2v_share", "seam_share", "seam_worst_mm")


def figures(
    rows: Mapping[str, Float[np.ndarray, "clip metric"]],
    episode: Int[np.ndarray, "clip"],
    prefix: str,
    *,
    seed: int,
) -> dict[str, float | None]:
    """Return mean (median for `MEDIANS`) and 95 % interval over episodes of all metrics and methods.

    None if no clip has a finite value.
    """
    found: dict[str, float | None] = {}
    for method, values in rows.items():
        for metric, column in zip(METRICS, values.T, strict=True):
            rng, middle = np.random.default_rng(seed), metric in MEDIANS
            interval = bootstrapped(column, episode[: len(column)], rng, median=middle)
            found |= interval.as_figures(f"{prefix}/{method}/{metric}")
    return found


def text(found: Mapping[str, float | None]) -> str:
    """Return all tables of all sources of motion."""
    parts = []
    for prefix, title in (
        ("longterm", "built-in world, held-out sessions and an unseen home"),
        ("longterm_unseen", "built-in world, the unseen home alone"),
        ("longterm_blocked", "built-in world, something in the way"),
        ("longterm_recorded", "reconstructed motion, test recording"),
        ("longterm_recorded_blocked", "reconstructed motion, something in the way"),
    ):
        for number, columns in ((1, TABLE_1), (2, TABLE_2), (4, TABLE_4)):
            if methods := _methods(prefix, found):
                parts.append(_table(f"Table {number}: {title}", prefix, methods, columns, found))
        for prefix_s in dict.fromkeys(name.split("/")[0] for name in found):
            if (length := re.fullmatch(rf"{prefix}_(\d+)s", prefix_s)) is not None:
                named = f"{length[1]} s, the body given every 2 s: {title}"
                parts.append(_table(named, prefix_s, _methods(prefix_s, found), LENGTHS, found))
    others = [name for name in found if name.split("/")[0] in ("longterm_minutes", "longterm_samples")]
    if others:
        rows = [(name, formatted_interval(found, name)) for name in others]
        parts.append(aligned("Minutes of motion, and samples of the behavior model", rows))
    return "\n\n".join(parts)


def _methods(prefix: str, found: Mapping[str, float | None]) -> list[str]:
    names = (name.split("/") for name in found if name.startswith(f"{prefix}/") and name.count("/") == 2)
    return list(dict.fromkeys(name[1] for name in names))


def _table(
    title: str, prefix: str, methods: list[str], columns: tuple[str, ...], found: Mapping[str, float | None]
) -> str:
    rows = [["method", *columns]]
    for method in methods:
        names = (f"{prefix}/{method}/{column}" for column in columns)
        rows.append([method, *(formatted_interval(found, name) for name in names)])
    return aligned(title, rows)
