"""The animal's root where a frame shows too little of it: tracked from the frames around that show more.

A hind leg at the border of a picture fits the template in many places. What the animal did just before or
after does not.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.geometry import rigid
from stages.register_videos import agent_fit
from stages.register_videos.agent_fit import AgentModel, AgentObservation, PosePrior, PriorFit

SURE_SHARE, USUAL_QUANTILE, WORSE_M = 0.25, 0.3, 0.012
"""A frame stands by itself if it shows this share of the animal, or more of it than most frames do, and its
cost exceeds the usual one, a quantile over the recording, by no more than this, metres."""
MIN_SHARE, LOST_M = 0.03, 0.036
"""A track ends where less of the animal is seen, or where the cost exceeds the usual one by more, metres."""
LONGEST_S = 1.0
"""Gap between two frames across which nothing is predicted, seconds."""
NOISE, SPEED = (float(np.deg2rad(5.0)), 0.01), (float(np.deg2rad(100.0)), 0.4)
"""Standard deviation of a prediction (radians, metres), and what each second adds to it at least: a walking
cat. In a recording that shows the animal to be faster it is that."""
ROUNDS = 12
"""Gauss-Newton steps."""


def excess(cost_m: Float[np.ndarray, "frame"]) -> Float[np.ndarray, "frame"]:
    """Return by how much each cost exceeds the usual one, metres; infinite where there is none."""
    known = np.isfinite(cost_m)
    if not known.any():
        return np.full(len(cost_m), np.inf)
    return np.where(known, np.maximum(np.nan_to_num(cost_m) - usual(cost_m), 0), np.inf)


def usual(cost_m: Float[np.ndarray, "frame"]) -> float:
    """Return the cost of a good fit in this recording, metres."""
    return float(np.nanquantile(cost_m, USUAL_QUANTILE))


@dataclass(frozen=True)
class Tracker:
    """What one recording shows of the animal, and where each frame alone places it."""

    timestamp_s: Float[np.ndarray, "frame"]
    world_from_agent: Float[np.ndarray, "frame 4 4"]
    cost_m: Float[np.ndarray, "frame"]
    """`agent_fit.cost`; NaN where the animal is not visible."""
    share: Float[np.ndarray, "frame"]
    """Visible area over the area in full view."""
    observe: Callable[[int], AgentObservation | None]
    model: AgentModel

    def track(self) -> tuple[Float[np.ndarray, "frame 4 4"], Float[np.ndarray, "frame"]]:
        """Track through the frames that do not stand by themselves, forward and backward.

        Returns roots and their costs, NaN where none is placed. Of both directions the one of least cost is
        taken. It replaces the frame's own pose unless that fits better by more than `WORSE_M`. What no
        direction reaches is not placed: it may be wrong.
        """
        seen = np.flatnonzero(np.isfinite(self.cost_m))
        if not len(seen):
            return self.world_from_agent, self.cost_m
        enough = min(SURE_SHARE, float(np.median(self.share[seen])))
        stands = (self.share >= enough) & (excess(self.cost_m) <= WORSE_M)
        found: dict[int, PriorFit] = {}
        for order in (seen, seen[::-1]):
            for frame, fit in self._sweep(order, stands):
                if frame not in found or fit.total_m < found[frame].total_m:
                    found[frame] = fit
        poses, costs = self.world_from_agent.copy(), self.cost_m.copy()
        poses[~stands], costs[~stands] = np.nan, np.nan
        for frame, fit in found.items():
            alone = fit.cost_m >= self.cost_m[frame] + WORSE_M
            poses[frame] = self.world_from_agent[frame] if alone else fit.world_from_agent
            costs[frame] = self.cost_m[frame] if alone else fit.cost_m
        return poses, costs

    def _sweep(
        self, order: Int[np.ndarray, "seen"], stands: Bool[np.ndarray, "frame"]
    ) -> Iterator[tuple[int, PriorFit]]:
        """Predict each frame that does not stand from the one before it in ``order``; yield frames and their
        fits, until one does not fit."""
        before, pose, most, speed = 0, None, usual(self.cost_m) + LOST_M, self._speed(stands)
        for frame in order.tolist():
            elapsed = abs(float(self.timestamp_s[frame] - self.timestamp_s[before]))
            before = frame
            if stands[frame]:
                pose = self.world_from_agent[frame]
                continue
            observation = self.observe(frame) if pose is not None and elapsed <= LONGEST_S else None
            if observation is None or pose is None:
                pose = None
                continue
            sigma = (NOISE[0] + speed[0] * elapsed, NOISE[1] + speed[1] * elapsed)
            fit = agent_fit.fit_near(observation, self.model, PosePrior(pose, sigma), rounds=ROUNDS)
            if fit.cost_m > most or self.share[frame] < MIN_SHARE:
                pose = None
                continue
            pose = fit.world_from_agent
            yield frame, fit

    def _speed(self, stands: Bool[np.ndarray, "frame"]) -> tuple[float, float]:
        """Return the usual speeds between neighbours that stand by themselves, or `SPEED` if that is more."""
        first = np.flatnonzero(stands[:-1] & stands[1:])
        if not len(first):
            return SPEED
        elapsed = np.diff(self.timestamp_s)[first, None]
        moved = rigid.log(rigid.inverse(self.world_from_agent[first]) @ self.world_from_agent[first + 1])
        speeds = (np.linalg.norm(part / elapsed, axis=1) for part in np.split(moved, 2, axis=1))
        turning, walking = (float(np.median(speed)) for speed in speeds)
        return max(SPEED[0], turning), max(SPEED[1], walking)
