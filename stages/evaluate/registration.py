"""Cameras and agent roots of all sessions against truth; every frame of a refused recording failed."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from pipeline.metrics.metrics import Metrics, mean, median, percentile
from pipeline.metrics.pose_errors import PoseErrors, joined
from stages.evaluate.reliability import reliability_metrics

REFUSED, REFUSED_TENTH = "more than half of the frames have no pose", "a tenth of the frames has no pose"
GOOD = (2.0, 0.05)
"""degrees and meters within which a pose counts as right"""
GOOD_ROOT = (20.0, 0.08)
"""likewise for the animal's root: what its localizer is held to"""
FLIPPED_DEG = 90.0
"""a root turned by more than this has front and back confused"""
COVERAGES = (0.5, 0.8)


def camera_metrics(
    errors: Mapping[str, PoseErrors], confidence: Mapping[str, Float[np.ndarray, "frame"]], registered: int
) -> Metrics:
    """Summarize camera errors of all sessions, and of the frames that were most certain."""
    metrics, all_errors = Metrics(), joined(list(errors.values()))
    put_cameras(metrics, all_errors)
    metrics.put("registration/videos_registered", registered)
    metrics.put("registration/videos_total", len(errors))
    right = is_right(all_errors)
    metrics.put("registration/within_2deg_5cm_share", mean(right))
    certain = np.concatenate([confidence[id] for id in errors]) if errors else np.zeros(0)
    metrics.add(reliability_metrics("registration", certain, right))
    order = np.argsort(-certain, kind="stable")
    for coverage in COVERAGES:
        covered = order[: round(coverage * len(order))]
        name = f"registration/at_coverage_{round(100 * coverage)}"
        metrics.put(f"{name}_rotation_deg_median", median(all_errors.degrees[covered]), REFUSED)
        metrics.put(f"{name}_translation_m_median", median(all_errors.meters[covered]), REFUSED)
    return metrics


def is_right(errors: PoseErrors, within: tuple[float, float] = GOOD) -> Bool[np.ndarray, "frame"]:
    """Return which poses are within so many degrees and meters of truth."""
    return (errors.degrees <= within[0]) & (errors.meters <= within[1])


def root_metrics(
    name: str, errors: Sequence[PoseErrors], placed: Sequence[Bool[np.ndarray, "frame"]] | None = None
) -> Metrics:
    """Summarize the agent's root over the frames in which it is truly visible; ``placed`` marks where it is
    known; by default where a pose is given.
    """
    metrics, all_errors = Metrics(), joined(list(errors))
    metrics.put(f"{name}/agent_root_m_median", median(all_errors.meters), REFUSED)
    metrics.put(f"{name}/agent_root_deg_median", median(all_errors.degrees), REFUSED)
    metrics.put(f"{name}/agent_root_m_p90", percentile(all_errors.meters, 90), REFUSED_TENTH)
    given = np.isfinite(all_errors.degrees)
    known = np.concatenate(placed) & given if placed else given
    metrics.put(f"{name}/agent_flips_share", mean(all_errors.degrees[known] > FLIPPED_DEG))
    metrics.put(f"{name}/agent_placed_share", mean(known))
    return metrics


def put_cameras(metrics: Metrics, errors: PoseErrors, frames: str = "frames") -> None:
    """Record median and 95th percentile of camera errors; ``frames`` names them in reasons."""
    for unit, values in (("rotation_deg", errors.degrees), ("translation_m", errors.meters)):
        many, few = (f"{share} of the {frames}" for share in ("more than half", "a twentieth"))
        metrics.put(f"registration/{unit}_median", median(values), f"{many} have no pose")
        metrics.put(f"registration/{unit}_p95", percentile(values, 95), f"{few} has no pose")
