"""The person with the phone: follows the animal, walks up to it, stands, steps back, strolls.

A small random state machine. Who films comes up every 8 to 10 s so that what the animal does about people can
be learned from minutes of video, mostly from where the animal came to; who lives there leaves it alone for
longer, goes off again, and comes up from across the room. Positions (x, z) on the floor in meters, yaw about
+y.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stages.synthesize_capture.navigation import Floor, Ground, Walker

REACTION_S = 0.28
Range = tuple[float, float]


@dataclass(frozen=True)
class ObserverStyle:
    """How a person moves; ranges are sampled uniformly, times in seconds, speeds in m/s."""

    watch_s: Range = (7.0, 9.0)
    approach_s: Range = (2.0, 3.0)
    approach_m_s: Range = (0.9, 1.2)
    retreat_s: Range = (1.4, 2.2)
    retreat_m_s: Range = (0.6, 0.85)
    far_m: float = 2.7
    """from beyond this distance, the person first strolls to filming distance before an approach"""
    stays: float = 0.8
    """probability of standing still after an approach, rather than stepping back"""
    comes_up: float = 0.88
    """probability of an approach after standing, rather than a stroll"""


FILMING = ObserverStyle()
AT_HOME = ObserverStyle(
    watch_s=(4.0, 20.0),
    approach_s=(4.0, 6.0),
    approach_m_s=(0.8, 1.3),
    retreat_s=(2.0, 4.0),
    retreat_m_s=(0.7, 1.1),
    far_m=4.0,
    stays=0.1,
    comes_up=0.95,
)


class Observer:
    """A person who films; `step` advances it, `looks_at` is what the phone points to."""

    def __init__(
        self, floor: Floor, position: Ground, rng: np.random.Generator, style: ObserverStyle = FILMING
    ):
        self.walker = Walker(floor, floor.nearest(position), 0.0, turn_rate=2.6, acceleration=2.2)
        self.rng, self.style = rng, style
        self.mode, self.left_s, self.speed_m_s, self.since_plan_s = "watch", rng.uniform(1.0, 2.0), 0.0, 0.0
        self.velocity = np.zeros(2)
        self.looks_at: Float[np.ndarray, 3] = np.full(3, np.nan)
        self._last: np.ndarray | None = None
        self._glance: tuple[float, np.ndarray] | None = None

    def step(self, seconds: float, animal: Float[np.ndarray, "3"]) -> None:
        """Advance by one step, given the animal's position (x, y, z)."""
        before = self.walker.position.copy()
        self._last = animal if self._last is None else self._last
        ground = animal[[0, 2]]
        self.left_s -= seconds
        self.since_plan_s += seconds
        if self.mode == "approach":
            startled = np.linalg.norm(animal - self._last) > 1.2 * seconds
            if np.linalg.norm(ground - self.walker.position) < 0.62 or startled:
                self.left_s = min(self.left_s, 0.3)
            elif self.since_plan_s > 0.5:
                self._plan_approach(ground)
        if self.left_s <= 0:
            self._choose(ground)
        toward = ground - self.walker.position
        self.walker.step(seconds, self.speed_m_s, face=float(np.arctan2(toward[0], toward[1])))
        self.velocity = (self.walker.position - before) / seconds
        self._last = animal
        self._look(seconds, animal)

    def _choose(self, animal: Ground) -> None:
        """Choose the next mode."""
        style = self.style
        self.walker.stop()
        self.speed_m_s = 0.0
        after = {
            "approach": ("watch", "retreat"),
            "watch": ("approach", "stroll"),
            "retreat": ("watch", "approach"),
            "stroll": ("approach", "watch"),
        }
        chance = {"approach": style.stays, "watch": style.comes_up, "retreat": 1.0, "stroll": 0.2}[self.mode]
        far = self.mode != "stroll" and np.linalg.norm(self.walker.position - animal) > style.far_m
        self.mode = "stroll" if far else after[self.mode][0 if self.rng.random() < chance else 1]
        match self.mode:
            case "watch":
                self.left_s = self.rng.uniform(*style.watch_s)
            case "approach":
                self.left_s = self.rng.uniform(*style.approach_s)
                self.speed_m_s = self.rng.uniform(*style.approach_m_s)
                self._plan_approach(animal)
            case "retreat":
                self.left_s = self.rng.uniform(*style.retreat_s)
                self.speed_m_s = self.rng.uniform(*style.retreat_m_s)
                centers = self.walker.floor.centers()
                away = np.linalg.norm(centers - animal, axis=-1)
                far = np.linalg.norm(centers - self.walker.position, axis=-1)
                self.walker.go(centers[np.argmax(0.9 * away - 0.5 * far)], avoid=animal)
            case "stroll":
                self.left_s, self.speed_m_s = self.rng.uniform(2.4, 3.8), self.rng.uniform(0.5, 0.8)
                from_animal = self.walker.position - animal
                angle = np.arctan2(from_animal[0], from_animal[1]) + self.rng.normal(0, 0.5)
                self.walker.go(animal + 2.1 * np.array([np.sin(angle), np.cos(angle)]), avoid=animal)

    def _plan_approach(self, animal: Ground) -> None:
        self.since_plan_s = 0.0
        self.walker.go(animal)

    def _look(self, seconds: float, animal: Float[np.ndarray, "3"]) -> None:
        """Follow the animal with a lag; sometimes glance elsewhere for a moment."""
        target = animal + np.array([0.0, 0.12, 0.0])
        often = 3.0 if self.mode == "stroll" else 1.0
        if self._glance is None and self.rng.random() < 0.02 * seconds * often:
            self._glance = (self.rng.uniform(0.5, 1.0), target + self.rng.uniform((-1, 0, -1), (1, 0.6, 1)))
        if self._glance is not None:
            left, sideways = self._glance
            target = sideways
            self._glance = (left - seconds, sideways) if left > seconds else None
        if np.isnan(self.looks_at).any():  # the first look
            self.looks_at = target.copy()
        self.looks_at = self.looks_at + (target - self.looks_at) * (1 - np.exp(-seconds / REACTION_S))
