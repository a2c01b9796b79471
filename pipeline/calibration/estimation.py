"""Fit a depth camera to the edges of pictures: outlines of depth lie where gradients of pictures are strong.

The mean gradient at the outlines is maximized over all parameters jointly, from coarse to fine. Standard
errors are those of an M-estimator whose errors are correlated within blocks of frames (sandwich estimator,
Huber 1967; Liang and Zeger 1986).
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import minimize

from pipeline.calibration.depth_steps import PARAMETERS, StepProfiles

TYPICAL = {
    "focal": 0.05, "x": 0.03, "y": 0.03, "pitch": 0.02, "yaw": 0.02, "roll": 0.02,
    "delay": 0.1, "margin": 2.0,
}  # fmt: skip
"""size of each parameter, in its unit; the estimate is weakly drawn to zero by these"""
SEARCHED, STARTS = ("focal", "x", "y"), (-2, -1, 0, 1, 2)
"""parameters with several starts, and these, in units of `TYPICAL`"""
START_POINTS = 4000
"""points on which starts are compared"""
COARSE, FINE_PX = 0.2, 1.5
"""first blur along profiles, share of their reach, which is halved until the last one, pixels"""
PRIOR = 1e-3
"""weight of squared parameters, in units of `TYPICAL`, against the mean relative gradient"""
BLOCK_FRAMES = 4
"""consecutive sampled frames whose errors may be correlated"""
MIN_PROFILES, MIN_STEP_FRAMES = 1000, 16
"""minimum points, and minimum of frames that show them"""


@dataclass(frozen=True)
class ParameterFit:
    """Estimated `PARAMETERS`, 0 where not estimated."""

    value: Float[np.ndarray, "parameter"]
    covariance: Float[np.ndarray, "parameter parameter"]

    @property
    def error(self) -> Float[np.ndarray, "parameter"]:
        """Standard errors."""
        return np.sqrt(np.diag(self.covariance))


def start(steps: StepProfiles) -> tuple[float, Float[np.ndarray, "parameter"]]:
    """Return the best of a coarse grid of parameters, after its score, which is -inf without points."""
    if not len(steps.frame):
        return -np.inf, np.zeros(len(PARAMETERS))
    some = slice(None, None, max(1, len(steps.frame) // START_POINTS))
    scale = np.array(list(TYPICAL.values()))
    blur_px = max(FINE_PX, COARSE * (steps.gradient.shape[1] // 2))
    score = _EdgeScore(_blurred(steps.gradient[some], blur_px), steps.derivative[some] * scale)
    choices = [STARTS if name in SEARCHED else (0,) for name in PARAMETERS]
    grid = [np.array(each, float) for each in itertools.product(*choices)]
    values = [-score.cost(each)[0] for each in grid]
    return max(values), grid[int(np.argmax(values))] * scale


def fit(steps: StepProfiles, free: Sequence[str] = PARAMETERS) -> ParameterFit | None:
    """Estimate the ``free`` parameters from 0; None if too little is seen or no maximum is found."""
    if len(steps.frame) < MIN_PROFILES or len(np.unique(steps.frame)) < MIN_STEP_FRAMES:
        return None
    columns, scale = [PARAMETERS.index(name) for name in free], np.array([TYPICAL[name] for name in free])
    derivative, reach = steps.derivative[:, columns] * scale, steps.gradient.shape[1] // 2
    value, blurs_px = np.zeros(len(free)), [FINE_PX]
    while 2 * blurs_px[0] <= COARSE * reach:
        blurs_px.insert(0, 2 * blurs_px[0])
    for blur_px in blurs_px:
        score = _EdgeScore(_blurred(steps.gradient, blur_px), derivative)
        value = minimize(score.cost, value, jac=True, method="BFGS").x
    covariance = _covariance(score, value, steps.frame)
    if covariance is None:
        return None
    values, covariances = np.zeros(len(PARAMETERS)), np.zeros((len(PARAMETERS),) * 2)
    values[columns], covariances[np.ix_(columns, columns)] = (
        value * scale,
        covariance * np.outer(scale, scale),
    )
    return ParameterFit(values, covariances)


def contrast(steps: StepProfiles) -> float:
    """Return the mean relative gradient at the points; NaN without any."""
    if not len(steps.frame):
        return np.nan
    return float(_blurred(steps.gradient, FINE_PX)[:, steps.gradient.shape[1] // 2].mean())


def _blurred(
    gradient: Float[np.ndarray, "point offset"], blur_px: float
) -> Float[np.ndarray, "point offset"]:
    return gaussian_filter1d(gradient, blur_px, axis=1, mode="constant")


@dataclass(frozen=True)
class _EdgeScore:
    """Gradient along profiles, and derivatives of their points by parameters in units of `TYPICAL`."""

    gradient: Float[np.ndarray, "point offset"]
    derivative: Float[np.ndarray, "point parameter"]

    def cost(self, value: Float[np.ndarray, "parameter"]) -> tuple[float, Float[np.ndarray, "parameter"]]:
        """Return the negative mean gradient at shifted points, with the prior, and its derivative."""
        gradient, slope, _ = self.at(value)
        change = -slope @ self.derivative / len(slope) + 2 * PRIOR * value
        return PRIOR * float(value @ value) - float(gradient.mean()), change

    def at(self, value: Float[np.ndarray, "parameter"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return gradients at points shifted by parameters, and their first and second derivatives.

        Between samples the slope is interpolated linearly such that the gradient is its integral (quadratic
        B-spline); 0 beyond the reach.
        """
        last = self.gradient.shape[1] - 1
        shift = self.derivative @ value + last / 2
        left = np.clip(np.round(shift).astype(int), 1, last - 1)
        part, inside = shift - left, (shift > 0) & (shift < last)
        at = left + (last + 1) * np.arange(len(left))
        low, middle, high = (self.gradient.ravel()[at + step] for step in (-1, 0, 1))
        slope, bend = (high - low) / 2, high - 2 * middle + low
        gradient = middle + bend / 8 + slope * part + bend * part**2 / 2
        return gradient * inside, (slope + bend * part) * inside, bend * inside


def _covariance(
    score: _EdgeScore, value: Float[np.ndarray, "parameter"], frame: Int[np.ndarray, "point"]
) -> Float[np.ndarray, "parameter parameter"] | None:
    """Return the sandwich covariance at a maximum; None where it is none."""
    _, slope, bend = score.at(value)
    weighted = -bend[:, None] * score.derivative
    curvature = weighted.T @ score.derivative + 2 * PRIOR * len(frame) * np.eye(len(value))
    if np.linalg.eigvalsh(curvature).min() <= 0:
        return None
    block = frame // BLOCK_FRAMES
    sums = np.zeros((block.max() + 1, len(value)))
    np.add.at(sums, block, slope[:, None] * score.derivative)
    inverse = np.linalg.inv(curvature)
    return inverse @ sums.T @ sums @ inverse
