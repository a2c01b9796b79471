"""Reaction of the animal of an open page to people, with the same noise for a distant, near and opposite
observer.
"""

import numpy as np
from playwright.sync_api import Page

FAR_M = 9.0


def goals(page: Page, places: np.ndarray, **more: object) -> np.ndarray:
    """Sample goals on the floor, meters, for an observer that walked over `places` [place 2] in steps of 0.1
    s.
    """
    question = {"observer": np.atleast_2d(places).tolist(), "seed": 7, "K": 16, **more}
    return np.array(page.evaluate("question => ats.sampleGoals(question)", question))[:, [0, 2]]


def approach(here: np.ndarray, side: np.ndarray, near_m: float, speed_m_s: float) -> np.ndarray:
    """Return a straight walk to the animal of 0.8 s that ends `near_m` away on its `side`."""
    return here + side * (near_m + speed_m_s * 0.1 * np.arange(7, -1, -1)[:, None])


def away_m(page: Page, near_m: float = 0.6, speed_m_s: float = 0.8, directions: int = 8) -> np.ndarray:
    """Return, per direction of approach, the shift of goals away from the observer, meters, relative to a
    distant one.
    """
    here = np.array(page.evaluate("ats.state()")["animal"])[[0, 2]]
    angle = np.arange(directions) * 2 * np.pi / directions
    shifts = []
    for side in np.stack([np.cos(angle), np.sin(angle)], -1):
        shift = goals(page, approach(here, side, near_m, speed_m_s)) - goals(page, here + FAR_M * side)
        shifts.append(-shift.mean(0) @ side)
    return np.array(shifts)
