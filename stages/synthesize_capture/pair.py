"""Let two animals live together: a cat that minds the person and the dog, and a dog that plays with the cat,
follows it and leaves it alone in turn.

`simulate_pair` is `session.simulate_session` for two; the person films whom it looks at, one or both.
"""

from collections import deque
from typing import Literal

import numpy as np
from jaxtyping import Float

from stages.synthesize_capture.dog import DOG
from stages.synthesize_capture.navigation import Floor, Ground, floor_for
from stages.synthesize_capture.observer import FILMING, Observer, ObserverStyle
from stages.synthesize_capture.policy import DELAY_S, REASONS, Policy, SeenPerson
from stages.synthesize_capture.room import Place, Room
from stages.synthesize_capture.session import (
    ANIMAL_BREADTH_M,
    ANIMAL_HEIGHT_M,
    PERSON_BREADTH_M,
    PERSON_HEIGHT_M,
    STEP_S,
    SessionTrajectories,
    course_from_rows,
    course_row,
)

Mode = Literal["own", "follow", "play", "avoid"]
NEXT: dict[Mode, tuple[tuple[Mode, ...], tuple[float, ...]]] = {
    "own": (("follow", "play"), (0.6, 0.4)),
    "follow": (("play", "own", "avoid"), (0.4, 0.3, 0.3)),
    "play": (("avoid", "follow", "own"), (0.5, 0.25, 0.25)),
    "avoid": (("own", "follow"), (0.5, 0.5)),
}
"""What follows a mode, and how likely."""
LASTING_S: dict[Mode, tuple[float, float]] = {
    "own": (2.0, 4.0),
    "follow": (4.0, 8.0),
    "play": (2.0, 4.0),
    "avoid": (2.0, 4.0),
}
PACE_M_S: dict[Mode, float] = {"own": 0.7, "follow": 0.9, "play": 1.5, "avoid": 1.2}
REACH_M: dict[Mode, float] = {"follow": 0.95, "play": 0.75}
"""How near it comes to the other, centre to centre."""
PLANNED_S = 0.4
"""It looks again where the other is after so long."""
APART_M, PUSH_M_S = 0.62, 1.2
"""Centres of two bodies on the floor are no nearer, and how fast they get out of each other's way."""
MINDED_M = 1.0
"""The cat minds a dog that comes nearer."""
FOCUS_PERIOD_S, BOTH_M = 9.0, 1.5
"""The phone goes from one animal to the other and back in this time; both are filmed when they are as
near."""


class Companion(Policy):
    """A dog's mind: it stays on the floor and goes by where the other animal is."""

    def __init__(self, floor: Floor, places: tuple[Place, ...], position: Ground, rng: np.random.Generator):
        low = tuple(place for place in places if place.position[1] < 0.1)
        super().__init__(floor, low, position, rng)
        self.mode: Mode = "follow"
        self.left_s, self.planned_s = rng.uniform(1.0, 3.0), 0.0
        self.other = SeenPerson(self.walker.position, np.zeros(2))

    def live(self, seconds: float, person: SeenPerson, other: SeenPerson) -> None:
        """Decide by person and other animal, then move on by one step."""
        self.other = other
        self.step(seconds, person)

    def _decide(self, seconds: float, seen: SeenPerson) -> None:
        if self.distance < 0.5 and self.closing > 0.25 and self.fear_s <= 0:
            self._flee(seen)
            return
        self.left_s -= seconds
        self.planned_s -= seconds
        if self.left_s <= 0:
            modes, chances = NEXT[self.mode]
            self.mode = modes[self.rng.choice(len(modes), p=chances)]
            self.left_s = self.rng.uniform(*LASTING_S[self.mode])
            self.planned_s = 0.0
            self.walker.stop()
        if self.planned_s > 0 or self.fear_s > 0:
            return
        self.planned_s, self.reason = PLANNED_S, "own"
        off = self.walker.position - self.other.position
        distance = float(np.linalg.norm(off))
        match self.mode:
            case "own":
                if self.walker.arrived() and self.rng.random() < 0.4:
                    self._visit()
            case "follow" | "play":
                reach = REACH_M[self.mode]
                self._leave()
                if distance > reach + 0.1:
                    self._go(self.other.position + reach * off / max(distance, 1e-6))
            case "avoid":
                if distance < 1.8 and self.walker.arrived():
                    centers = self.walker.floor.centers()
                    away = np.linalg.norm(centers - self.other.position, axis=-1)
                    near = np.linalg.norm(centers - self.walker.position, axis=-1)
                    noise = self.rng.gumbel(0, 0.1, len(centers))
                    self._go(centers[np.argmax(np.minimum(away, 2.5) - 0.5 * near + noise)])

    def _go(self, goal: Ground) -> None:
        self._leave()
        self.speed_m_s = PACE_M_S[self.mode]
        self.walker.go(goal)


def simulate_pair(
    room: Room, rng: np.random.Generator, duration_s: float, style: ObserverStyle = FILMING
) -> SessionTrajectories:
    """Simulate one session of a cat and a dog; the same generator state gives the same session."""
    footprints = room.footprints()
    cats = floor_for(footprints, breadth_m=ANIMAL_BREADTH_M, height_m=ANIMAL_HEIGHT_M)
    dogs = floor_for(footprints, breadth_m=ANIMAL_BREADTH_M * DOG.size, height_m=ANIMAL_HEIGHT_M * DOG.size)
    people = floor_for(footprints, breadth_m=PERSON_BREADTH_M, height_m=PERSON_HEIGHT_M)
    start = people.centers()[rng.integers(people.free.sum())]
    cat = Policy(cats, room.places, _at_distance(cats, start, 2.0, rng), rng)
    dog = Companion(dogs, room.places, _at_distance(dogs, cat.walker.position, 1.2, rng), rng)
    observer, phase = Observer(people, start, rng, style), rng.uniform(0, 2 * np.pi)
    past: deque[tuple[SeenPerson, ...]] = deque(maxlen=max(1, round(DELAY_S / STEP_S)))
    courses, person, reason = ([], []), [], []
    for index in range(int(np.ceil(duration_s / STEP_S)) + 2):
        observer.step(STEP_S, _focus(cat, dog, index * STEP_S, phase))
        walker = observer.walker
        past.append((SeenPerson(walker.position.copy(), observer.velocity.copy()), _seen(cat), _seen(dog)))
        seen_person, seen_cat, seen_dog = past[0]
        cat.step(STEP_S, _minded(cat, seen_person, seen_dog))
        dog.live(STEP_S, seen_person, seen_cat)
        _keep_apart(cat, dog)
        for course, each in zip(courses, (cat, dog), strict=True):
            course.append(course_row(each))
        person.append((walker.position.copy(), observer.looks_at.copy()))
        reason.append(REASONS.index(cat.reason))
    position, looks_at = (np.array(column) for column in zip(*person, strict=True))
    first, second = (course_from_rows(course) for course in courses)
    return SessionTrajectories(first, position, looks_at, np.array(reason), second)


def _at_distance(floor: Floor, start: Ground, distance_m: float, rng: np.random.Generator) -> Ground:
    centers = floor.centers()
    off = np.abs(np.linalg.norm(centers - start, axis=-1) - distance_m)
    return centers[np.argmin(off + rng.uniform(0, 0.5, len(centers)))]


def _seen(animal: Policy) -> SeenPerson:
    walker = animal.walker
    velocity = walker.speed * np.array([np.sin(walker.yaw), np.cos(walker.yaw)])
    return SeenPerson(walker.position.copy(), velocity)


def _minded(cat: Policy, person: SeenPerson, dog: SeenPerson) -> SeenPerson:
    """Return whom the cat minds: the dog when it is near and nearer than the person."""
    apart = [float(np.linalg.norm(each.position - cat.walker.position)) for each in (person, dog)]
    return dog if apart[1] < min(MINDED_M, apart[0]) else person


def _keep_apart(cat: Policy, dog: Companion) -> None:
    """Have bodies on the floor make way for each other: the dog, or the cat where the dog cannot."""
    if cat.height > 0.1 or cat.leap is not None:
        return
    off = dog.walker.position - cat.walker.position
    distance = float(np.linalg.norm(off))
    if distance >= APART_M:
        return
    way = off / distance if distance > 1e-6 else np.array([1.0, 0.0])
    step = min(APART_M - distance, PUSH_M_S * STEP_S)
    for animal, sign in ((dog, 1.0), (cat, -1.0)):
        goal = animal.walker.position + sign * step * way
        if animal.walker.floor.is_free(goal):
            animal.walker.position = goal
            return


def _focus(cat: Policy, dog: Companion, now_s: float, phase: float) -> Float[np.ndarray, "3"]:
    """Return what the person films: between both where they are near each other, else one and then the
    other.
    """
    apart = float(np.linalg.norm(cat.position - dog.position))
    turn = 0.5 + 0.5 * np.tanh(3 * np.sin(2 * np.pi * now_s / FOCUS_PERIOD_S + phase))
    both = np.clip((BOTH_M + 0.4 - apart) / 0.4, 0, 1)
    share = 0.5 * both + turn * (1 - both)
    return cat.position + share * (dog.position - cat.position)
