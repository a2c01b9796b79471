"""Cameras and agent roots of all sessions against truth: every frame counts, refused recordings as failures."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from stages.evaluate.alignment import PoseErrors, joined
from stages.evaluate.figures import Figures, median, percentile
from stages.evaluate.reliability import reliability_figures

REFUSED = "more than half of the frames have no pose"
GOOD = (2.0, 0.05)
"""degrees and metres within which a pose counts as right"""
FLIPPED_DEG = 90.0
"""a root turned by more than this has front and back confused"""
COVERAGES = (0.5, 0.8)


def camera_figures(errors: Mapping[str, PoseErrors], confidence: Mapping[str, Float[np.ndarray, "frame"]], registered: int) -> Figures:
    """Summarise camera errors of all sessions, and of the frames that were most certain."""
    figures, all_errors = Figures(), joined(list(errors.values()))
    _summarise(figures, "registration", all_errors)
    figures.put("registration/videos_registered", registered)
    figures.put("registration/videos_total", len(errors))
    right = is_right(all_errors)
    figures.put("registration/within_2deg_5cm_share", float(right.mean()) if len(right) else np.nan)
    certain = np.concatenate([confidence[id] for id in errors]) if errors else np.zeros(0)
    figures.add(reliability_figures("registration", certain, right))
    order = np.argsort(-certain, kind="stable")
    for coverage in COVERAGES:
        kept = order[: round(coverage * len(order))]
        name = f"registration/at_coverage_{round(100 * coverage)}"
        figures.put(f"{name}_rotation_deg_median", median(all_errors.degrees[kept]), REFUSED)
        figures.put(f"{name}_translation_m_median", median(all_errors.meters[kept]), REFUSED)
    return figures


def is_right(errors: PoseErrors) -> Bool[np.ndarray, "frame"]:
    """Tell which poses are what probabilities are given for."""
    return (errors.degrees <= GOOD[0]) & (errors.meters <= GOOD[1])


def root_figures(name: str, errors: Sequence[PoseErrors], placed: Sequence[Bool[np.ndarray, "frame"]] | None = None) -> Figures:
    """Summarise the agent's root over the frames in which it is truly visible; ``placed`` tells where it is known, None: where it is given."""
    figures, all_errors = Figures(), joined(list(errors))
    figures.put(f"{name}/agent_root_m_median", median(all_errors.meters), REFUSED)
    figures.put(f"{name}/agent_root_deg_median", median(all_errors.degrees), REFUSED)
    figures.put(f"{name}/agent_root_m_p90", percentile(all_errors.meters, 90), "a tenth of the frames has no pose")
    given = np.isfinite(all_errors.degrees)
    known = np.concatenate(placed) if placed else given
    figures.put(f"{name}/agent_flips_share", float((all_errors.degrees[given] > FLIPPED_DEG).mean()) if given.any() else np.nan)
    figures.put(f"{name}/agent_placed_share", float(known.mean()) if len(known) else np.nan)
    return figures


def _summarise(figures: Figures, name: str, errors: PoseErrors) -> None:
    for unit, values in (("rotation_deg", errors.degrees), ("translation_m", errors.meters)):
        figures.put(f"{name}/{unit}_median", median(values), REFUSED)
        figures.put(f"{name}/{unit}_p95", percentile(values, 95), "a twentieth of the frames has no pose")
