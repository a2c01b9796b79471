"""Poses that were inferred where nobody saw the agent, against truth: how often, and how far off."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from pipeline.models.motion import INFERRED, Motion
from stages.evaluate.alignment import joined, pose_errors
from stages.evaluate.figures import Figures, median
from stages.evaluate.reading import Frames, Recorded


def is_inferred(motion: Motion) -> Bool[np.ndarray, "frame"]:
    """Tell where the pose was inferred because nobody saw the agent; where it was seen, the camera alone may be in doubt."""
    return np.isfinite(motion.world_from_agent).all((1, 2)) & ~motion.agent_visible & (motion.confidence <= INFERRED)


def inferred_figures(sessions: Sequence[Recorded], motions: Mapping[str, Motion | None], frames: Frames) -> Figures:
    """Compare the root in all inferred frames, whether truly in view or not, with truth."""
    figures, errors, total = Figures(), [], 0
    for each in sessions:
        motion = motions[each.video.id]
        if motion is not None:
            guessed = is_inferred(motion)
            errors.append(pose_errors(motion.world_from_agent, frames.roots(each.truth))[guessed])
            total += len(guessed)
    found = joined(errors)
    figures.put("reconstruction/agent_inferred_share", len(found.meters) / total if total else np.nan, "no session was reconstructed")
    figures.put("reconstruction/agent_inferred_m_median", median(found.meters), "no pose is inferred")
    figures.put("reconstruction/agent_inferred_deg_median", median(found.degrees), "no pose is inferred")
    return figures
