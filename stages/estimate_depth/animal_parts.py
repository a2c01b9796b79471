"""Which of the parts recognized in each picture is the animal: the surest path over a recording.

Furniture may look like the animal, but it stays where it is, and the animal cannot have run there and back.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry import cameras, rigid, viterbi
from pipeline.geometry.contact import Contact
from stages.estimate_depth.foreground import MIN_GAP_S
from stages.estimate_depth.views import View

STATIC_COST = 2.0
"""Cost of a place at which all other frames that see it have such a part, too; in units of log evidence."""
JUMP_COST, MAX_M_S, SLACK_M = 10.0, 4.0, 0.3
"""Cost of a jump: faster than an animal that runs, beyond the error of contacts, meters."""
TYPICAL, WEAK = 0.9, 4.4
"""Quantile of a recording's log evidence that the whole animal has; cost from which on a part is not the
animal: an 80th of it, since furniture may hide the rest."""
LEAST_M2 = 1e-6
"""Floor of evidence, square meters."""
SAME_M, MIN_FRAMES = 0.3, 5
"""Contacts this close are at one place; least number of frames that a share is taken of."""


@dataclass(frozen=True)
class Part:
    """A part of a picture that may be the animal."""

    blobs: Sequence[Bool[np.ndarray, "height width"]]
    """Its connected components, largest first."""
    contacts: Sequence[Contact | None]
    """Of each component, with the map."""
    evidence: float
    """Integral of its log-odds over its area, square meters: small things look like parts of an animal."""

    @property
    def contact(self) -> Contact | None:
        """Return the contact of the largest component."""
        return self.contacts[0] if self.contacts else None


def follow(
    parts: Sequence[Sequence[Part]], views: Sequence[View], timestamp_s: Float[np.ndarray, "frame"]
) -> list[Part | None]:
    """Choose the animal's part in every frame by a Viterbi path; None where there is none, or a weak one."""
    none = Contact(np.full(3, np.nan), certain=False)
    points = [
        np.array([(one.contact or none).point_world for one in group]).reshape(-1, 3) for group in parts
    ]
    evidence = [np.log([max(each.evidence, LEAST_M2) for each in group]) for group in parts]
    frames = np.array([frame for frame, group in enumerate(parts) if group], int)
    if not len(frames):
        return [None] * len(parts)
    static = static_shares(points, views, timestamp_s)
    cost = [STATIC_COST * static[frame] - evidence[frame] for frame in frames]

    def change(index: int) -> Float[np.ndarray, "before after"]:
        before, after = frames[index - 1 : index + 1]
        moved_m = np.nan_to_num(np.linalg.norm(points[before][:, None] - points[after], axis=-1))
        return JUMP_COST * (moved_m > MAX_M_S * (timestamp_s[after] - timestamp_s[before]) + SLACK_M)

    path = viterbi.viterbi_decode(cost, change)
    limit = WEAK - float(np.quantile([each.max() for each in evidence if len(each)], TYPICAL))
    chosen: list[Part | None] = [None] * len(parts)
    for frame, costs, state in zip(frames.tolist(), cost, path, strict=True):
        chosen[frame] = parts[frame][state] if costs[state] < limit else None
    return chosen


def static_shares(
    points: Sequence[Float[np.ndarray, "_ 3"]], views: Sequence[View], timestamp_s: Float[np.ndarray, "frame"]
) -> list[Float[np.ndarray, "_"]]:
    """Return, of the other frames that see each point, the share that has a point there, too."""
    every, shares = np.concatenate(points), []
    frame_of = np.repeat(np.arange(len(points)), [len(each) for each in points])
    camera_from_world = rigid.inverse(np.stack([view.world_from_camera for view in views]))
    intrinsics, shape = views[0].intrinsics, views[0].gray.shape
    for own, time_s in zip(points, timestamp_s, strict=True):
        pixel, z = cameras.project(rigid.apply(camera_from_world, own), intrinsics)
        visible = cameras.in_picture(pixel, z, shape, 0.1).T & (np.abs(timestamp_s - time_s) > MIN_GAP_S)
        shown = np.zeros(visible.shape, bool)
        point, other = np.nonzero(np.linalg.norm(own[:, None] - every, axis=-1) < SAME_M)
        shown[point, frame_of[other]] = True
        shares.append((shown & visible).sum(1) / np.maximum(visible.sum(1), MIN_FRAMES))
    return shares
