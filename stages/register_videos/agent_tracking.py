"""Track the animal's root through frames that show too little of it.

A hind leg at the image border fits the template in many places; motion from reliable frames disambiguates it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.geometry import rigid
from stages.register_videos import agent_fit
from stages.register_videos.agent_fit import AgentModel, AgentObservation, PosePrior, PriorFit

RELIABLE_SHARE, TYPICAL_QUANTILE, MAX_EXCESS = 0.25, 0.3, 0.02
"""A frame is reliable if its visible share is at least the lower of this and the median, and its cost exceeds
the typical one (a quantile over the recording) by at most this, body lengths."""
MIN_SHARE, LOST_EXCESS = 0.03, 0.06
"""A track ends at a smaller visible share or a larger excess over the typical cost, body lengths."""
MAX_GAP_S = 1.0
"""Longest gap between frames that is bridged by prediction, seconds."""
PREDICTION_SIGMA, MIN_SPEED = (float(np.deg2rad(5.0)), 0.0167), (float(np.deg2rad(100.0)), 0.667)
"""Standard deviation of a prediction (radians, body lengths), and its least growth per second, that of a slow
walk; faster animals raise it."""
ROUNDS = 12
"""Gauss-Newton steps."""


def excess_cost(cost: Float[np.ndarray, "frame"]) -> Float[np.ndarray, "frame"]:
    """Return the excess of each cost over the typical one; infinite where unknown."""
    known = np.isfinite(cost)
    if not known.any():
        return np.full(len(cost), np.inf)
    return np.where(known, np.maximum(np.nan_to_num(cost) - typical_cost(cost), 0), np.inf)


def typical_cost(cost: Float[np.ndarray, "frame"]) -> float:
    """Return the typical cost of a good fit in this recording."""
    return float(np.nanquantile(cost, TYPICAL_QUANTILE))


@dataclass(frozen=True)
class Tracker:
    """Root poses of one recording, fitted frame by frame, to be completed by tracking."""

    timestamp_s: Float[np.ndarray, "frame"]
    world_from_agent: Float[np.ndarray, "frame 4 4"]
    cost: Float[np.ndarray, "frame"]
    """`agent_fit.cost`; NaN where the animal is not visible."""
    share: Float[np.ndarray, "frame"]
    """Visible share (`AgentObservation.share`)."""
    observe: Callable[[int], AgentObservation | None]
    model: AgentModel

    def track(self) -> tuple[Float[np.ndarray, "frame 4 4"], Float[np.ndarray, "frame"]]:
        """Track through unreliable frames, forward and backward.

        Returns roots and their costs, NaN where not placed. The fit of lower cost replaces the frame's own
        pose, unless that is better by more than `MAX_EXCESS`. Frames that neither reaches are not placed.
        """
        seen = np.flatnonzero(np.isfinite(self.cost))
        if not len(seen):
            return self.world_from_agent, self.cost
        enough = min(RELIABLE_SHARE, float(np.median(self.share[seen])))
        reliable = (self.share >= enough) & (excess_cost(self.cost) <= MAX_EXCESS)
        fits: dict[int, PriorFit] = {}
        for order in (seen, seen[::-1]):
            for frame, fit in self._sweep(order, reliable):
                if frame not in fits or fit.total < fits[frame].total:
                    fits[frame] = fit
        poses, costs = self.world_from_agent.copy(), self.cost.copy()
        poses[~reliable], costs[~reliable] = np.nan, np.nan
        for frame, fit in fits.items():
            keep_own = fit.cost >= self.cost[frame] + MAX_EXCESS
            poses[frame] = self.world_from_agent[frame] if keep_own else fit.world_from_agent
            costs[frame] = self.cost[frame] if keep_own else fit.cost
        return poses, costs

    def _sweep(
        self, order: Int[np.ndarray, "seen"], reliable: Bool[np.ndarray, "frame"]
    ) -> Iterator[tuple[int, PriorFit]]:
        """Fit each unreliable frame from its predecessor in ``order``; yield (frame, fit)."""
        previous, pose, speed = 0, None, self._typical_speed(reliable)
        max_cost = typical_cost(self.cost) + LOST_EXCESS
        for frame in order.tolist():
            elapsed = abs(float(self.timestamp_s[frame] - self.timestamp_s[previous]))
            previous = frame
            if reliable[frame]:
                pose = self.world_from_agent[frame]
                continue
            observation = self.observe(frame) if pose is not None and elapsed <= MAX_GAP_S else None
            if observation is None or pose is None:
                pose = None
                continue
            sigma_m = self.model.length_m * PREDICTION_SIGMA[1] + speed[1] * elapsed
            sigma = (PREDICTION_SIGMA[0] + speed[0] * elapsed, sigma_m)
            fit = agent_fit.fit_near(observation, self.model, PosePrior(pose, sigma), rounds=ROUNDS)
            if fit.cost > max_cost or self.share[frame] < MIN_SHARE:
                pose = None
                continue
            pose = fit.world_from_agent
            yield frame, fit

    def _typical_speed(self, reliable: Bool[np.ndarray, "frame"]) -> tuple[float, float]:
        """Return median speeds (rad/s, m/s) between reliable neighbors, at least `MIN_SPEED`."""
        first = np.flatnonzero(reliable[:-1] & reliable[1:])
        slowest = MIN_SPEED[0], self.model.length_m * MIN_SPEED[1]
        if not len(first):
            return slowest
        elapsed = np.diff(self.timestamp_s)[first, None]
        moved = rigid.log(rigid.inverse(self.world_from_agent[first]) @ self.world_from_agent[first + 1])
        speeds = (np.linalg.norm(part / elapsed, axis=1) for part in np.split(moved, 2, axis=1))
        turning, walking = (float(np.median(speed)) for speed in speeds)
        return max(slowest[0], turning), max(slowest[1], walking)
