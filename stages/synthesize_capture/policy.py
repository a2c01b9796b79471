"""What the animal decides: a goal-driven cat that reacts to the person with the phone.

It runs away when someone walks up to it, comes near when someone stands still or leaves, and
otherwise visits its favorite places, sits, lies and looks. Someone far away changes nothing.
Positions in meters, world axes; heights are those of what it stands on.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from pipeline.geometry import rigid
from stages.synthesize_capture.navigation import Floor, Ground, Walker
from stages.synthesize_capture.room import Place

STEP_S = 1.0 / 30.0
"""Time step of the simulation."""
DELAY_S = 0.25
"""Reaction time to the person."""
NOTICE_M = 3.0
FLIGHT_M = 2.2
"""Distance that it flees if it can run straight away."""
JUMP_S = 0.5
Reason = Literal["own", "flee", "approach"]
REASONS: tuple[Reason, ...] = ("own", "flee", "approach")


@dataclass(frozen=True)
class SeenWalker:
    """A perceived person or other animal: position and velocity on the floor."""

    position: Ground
    velocity: Ground


@dataclass
class Leap:
    """A jump in progress."""

    start: Float[np.ndarray, "3"]
    end: Float[np.ndarray, "3"]
    elapsed_s: float = 0.0


class Policy:
    """The animal's decisions and its path over the floor."""

    def __init__(self, floor: Floor, places: tuple[Place, ...], position: Ground, rng: np.random.Generator):
        self.rng, self.places = rng, places
        self.walker = Walker(
            floor, floor.nearest(position), rng.uniform(-np.pi, np.pi), turn_rate=4.0, acceleration=3.0
        )
        self.height = 0.0
        self.place: Place | None = None
        self.perch: Place | None = None
        self.reason: Reason = "own"
        self.speed_m_s, self.rest_s, self.calm_s, self.fear_s = 0.0, 0.6, 0.0, 0.0
        self.posture = np.zeros(3)
        self.wanted = np.zeros(3)
        self.leap: Leap | None = None
        self.gaze = np.array([*self.walker.position, 0.3])[[0, 2, 1]]
        self._gaze_goal, self._gaze_s = self.gaze.copy(), 0.0

    @property
    def position(self) -> Float[np.ndarray, "3"]:
        """Position: x, height of the ground under it, z."""
        return np.array([self.walker.position[0], self.height, self.walker.position[1]])

    def step(self, seconds: float, seen: SeenWalker) -> None:
        """Decide, then advance by one step."""
        self._perceive(seconds, seen)
        if self.leap is not None:
            self._fly(seconds)
        else:
            self._decide(seconds, seen)
            moving = not self.walker.arrived()
            if moving and self.perch is not None:
                self._jump(np.array([self.perch.entry[0], 0.0, self.perch.entry[1]]))
                self.perch = None
            else:
                self.walker.turn_rate = (7.5 if self.reason == "flee" else 4.0) if moving else 2.2
                self.walker.step(seconds, self.speed_m_s, face=None if moving else self._faces(seen))
                if moving and self.walker.arrived():
                    self._arrive()
        rate = 1 - np.exp(-seconds / 0.22)
        standing = self.walker.speed > 0.12 or self.leap is not None
        wanted = np.where(standing, np.array([0, 0, self.wanted[2]]), self.wanted)
        self.posture += rate * (wanted - self.posture)
        self._look(seconds, seen)

    def _perceive(self, seconds: float, seen: SeenWalker) -> None:
        """Update distance and closing speed of the person, and how long it has been calm."""
        away = self.walker.position - seen.position
        distance = float(np.linalg.norm(away))
        closing = float(seen.velocity @ away) / max(distance, 1e-6)
        self.closing, self.distance = closing, distance
        self.calm_s = self.calm_s + seconds if np.linalg.norm(seen.velocity) < 0.2 or closing < -0.3 else 0.0
        self.fear_s = max(self.fear_s - seconds, 0.0)

    def _threatened(self) -> bool:
        near = 0.95 if self.height > 0.1 else 1.25
        return (
            (self.distance < near and self.closing > 0.25)
            or self.distance < 0.55
            or (self.distance < near + 0.75 and self.closing > 0.65)
        )

    def _decide(self, seconds: float, seen: SeenWalker) -> None:
        if self._threatened() and self.fear_s <= 0:
            self._flee(seen)
            return
        if not self.walker.arrived():
            return
        self.rest_s -= seconds
        rested = self.reason == "own" or self.rest_s <= 0
        willing = self.reason != "approach" and rested and self.calm_s > 0.9
        if willing and 1.35 < self.distance < NOTICE_M + 0.5 and self.rng.random() < 1.8 * seconds:
            self._approach(seen)
        elif self.rest_s <= -2.5 and self.rng.random() < 0.5 * seconds:
            self._visit()

    def _flee(self, seen: SeenWalker) -> None:
        """Run to a free spot straight away from the person, about two meters off, not past it."""
        centers = self.walker.floor.centers()
        off = centers - self.walker.position
        length = np.linalg.norm(off, axis=-1)
        away = self.walker.position - seen.position
        away = away / max(float(np.linalg.norm(away)), 1e-6)
        straight = (off @ away) / np.maximum(length, 1e-6)
        clear = np.minimum(np.linalg.norm(centers - seen.position, axis=-1), 3.0)
        noise = self.rng.gumbel(0, 0.02, len(centers))
        score = 0.5 * clear + 3.0 * straight - 1.6 * np.abs(length - FLIGHT_M) + noise
        self.reason, self.fear_s, self.speed_m_s = "flee", 0.9, self.rng.uniform(1.7, 2.3)
        self._leave()
        goal = centers[np.argmax(score)]
        self.place = self._refuge(goal, seen)
        self.walker.go(goal if self.place is None else np.asarray(self.place.entry), avoid=seen.position)
        self.wanted = np.array([0.0, 0.0, 0.7])
        self.rest_s = self.rng.uniform(1.4, 2.0)

    def _refuge(self, goal: Ground, seen: SeenWalker) -> Place | None:
        """Return a high place near its direction of flight, not on the person's side."""
        for place in self.places:
            entry = np.asarray(place.entry)
            if (
                place.position[1] > 0.1
                and np.linalg.norm(entry - goal) < 0.8
                and np.linalg.norm(entry - seen.position) > 1.3
            ):
                return place
        return None

    def _approach(self, seen: SeenWalker) -> None:
        """Walk up to about a meter from the person, a little to one side."""
        from_person = self.walker.position - seen.position
        angle = np.arctan2(from_person[0], from_person[1]) + self.rng.normal(0, 0.15)
        goal = seen.position + self.rng.uniform(0.9, 1.05) * np.array([np.sin(angle), np.cos(angle)])
        self.reason, self.speed_m_s = "approach", self.rng.uniform(0.6, 0.9)
        self._leave()
        self.walker.go(goal)
        self.wanted = np.zeros(3)
        self.rest_s = self.rng.uniform(4.0, 7.0)

    def _visit(self) -> None:
        """Go to a favorite place, or to a random one."""
        away = np.array([np.linalg.norm(self.walker.position - place.entry) for place in self.places])
        weight = np.array([0.5 if place is self.perch else 1.0 for place in self.places]) * np.exp(
            -0.25 * away
        )
        self.reason, self.speed_m_s = "own", self.rng.choice([0.5, 0.7, 0.9, 1.3], p=[0.2, 0.4, 0.25, 0.15])
        self._leave()
        if self.rng.random() < 0.75:
            self.place = self.places[self.rng.choice(len(self.places), p=weight / weight.sum())]
            self.walker.go(np.asarray(self.place.entry))
        else:
            centers = self.walker.floor.centers()
            self.walker.go(centers[self.rng.integers(len(centers))])
        self.wanted = np.zeros(3)
        self.rest_s = self.rng.uniform(1.0, 3.2)

    def _leave(self) -> None:
        self.place = None
        self.wanted = np.zeros(3)

    def _arrive(self) -> None:
        """Jump up if the place is high, then settle: sit, lie or stand."""
        if self.place is not None and self.place.position[1] > 0.1:
            self.perch = self.place
            self._jump(np.asarray(self.place.position, float))
        sit, lie = {"flee": (0.15, 0.0), "approach": (0.65, 0.1), "own": (0.4, 0.25)}[self.reason]
        draw = self.rng.random()
        crouch = 0.3 if self.reason == "flee" else 0.0
        self.wanted = np.array([float(draw < sit), float(sit <= draw < sit + lie), crouch])

    def _jump(self, end: Float[np.ndarray, "3"]) -> None:
        self.leap = Leap(self.position, end)
        self.walker.speed = 0.0

    def _faces(self, seen: SeenWalker) -> float | None:
        """Return its heading at rest: outward from a perch, towards a noticed person, or None."""
        if self.perch is not None:
            return self.perch.yaw
        if self.reason == "own" or self.distance > NOTICE_M or self.posture[:2].max() > 0.3:
            return None
        toward = seen.position - self.walker.position
        return float(np.arctan2(toward[0], toward[1]))

    def _fly(self, seconds: float) -> None:
        leap = self.leap
        assert leap is not None, "only a leap is flown"
        leap.elapsed_s += seconds
        share = min(leap.elapsed_s / JUMP_S, 1.0)
        course = share * share * (3 - 2 * share)
        self.walker.position = (leap.start + course * (leap.end - leap.start))[[0, 2]]
        straight = leap.start[1] + course * (leap.end[1] - leap.start[1])
        self.height = float(straight + 4 * 0.16 * share * (1 - share))
        toward = (leap.end - leap.start)[[0, 2]]
        error = rigid.wrap(np.arctan2(toward[0], toward[1]) - self.walker.yaw)
        self.walker.yaw += float(np.clip(error, -9 * seconds, 9 * seconds))
        if share >= 1.0:
            self.height, self.leap = float(leap.end[1]), None

    def _look(self, seconds: float, seen: SeenWalker) -> None:
        """Turn the gaze: at the person when it matters, else ahead or around."""
        self._gaze_s -= seconds
        ahead = self.position + np.array([np.sin(self.walker.yaw), 0.22, np.cos(self.walker.yaw)])
        if self.walker.speed > 0.3:
            self._gaze_goal = ahead
        elif self._gaze_s <= 0:
            self._gaze_s = self.rng.uniform(0.6, 2.2)
            watch = self.distance < NOTICE_M and self.rng.random() < (0.8 if self.reason != "own" else 0.4)
            person = np.array([seen.position[0], 1.2, seen.position[1]])
            around = ahead + self.rng.uniform((-1, -0.2, -1), (1, 0.3, 1))
            self._gaze_goal = person if watch else around
        self.gaze = self.gaze + (self._gaze_goal - self.gaze) * (1 - np.exp(-seconds / 0.18))
