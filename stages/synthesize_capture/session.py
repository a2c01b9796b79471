"""Simulate animal and person together, without rendering.

`simulate_session` steps both at `STEP_S` and returns plain time series; poses, cameras and pictures
follow from them elsewhere, so this runs alone and fast.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from stages.synthesize_capture import companion
from stages.synthesize_capture.companion import Companion
from stages.synthesize_capture.dog import DOG
from stages.synthesize_capture.navigation import ANIMAL_M, PERSON_M, Floor, Ground, floor_for
from stages.synthesize_capture.observer import FILMING, Observer, ObserverStyle
from stages.synthesize_capture.policy import DELAY_S, REASONS, STEP_S, Policy, SeenWalker
from stages.synthesize_capture.room import Room
from stages.synthesize_capture.visitor import Visitor


@dataclass(frozen=True)
class AnimalCourse:
    """Where the animal's body goes: ground point under it, heading about +y, posture, gaze, tail."""

    timestamp_s: Float[np.ndarray, "sample"]
    position: Float[np.ndarray, "sample 3"]
    """x, height of what it stands on (or flies at), z."""
    yaw: Float[np.ndarray, "sample"]
    posture: Float[np.ndarray, "sample 3"]
    """How much it sits, lies, crouches, each 0 to 1."""
    airborne: Float[np.ndarray, "sample"]
    gaze: Float[np.ndarray, "sample 3"]
    """World point it looks at."""
    tail: Float[np.ndarray, "sample"]
    """-1 low and tense to 1 raised."""

    def speed(self) -> Float[np.ndarray, "sample"]:
        """Return the speed over ground in m/s."""
        return np.linalg.norm(np.gradient(self.position, self.timestamp_s, axis=0), axis=-1)


@dataclass(frozen=True)
class SessionTrajectories:
    """A session's truth before any camera: the animal's course, the person's, and why the animal moved."""

    animal: AnimalCourse
    observer_position: Float[np.ndarray, "sample 2"]
    observer_looks_at: Float[np.ndarray, "sample 3"]
    reason: Int[np.ndarray, "sample"]
    """Index into `policy.REASONS`."""
    companion: AnimalCourse | None = None
    """The course of a second animal."""
    visitor: AnimalCourse | None = None
    """The course of another person."""


def simulate_session(
    room: Room,
    rng: np.random.Generator,
    duration_s: float,
    style: ObserverStyle = FILMING,
    *,
    with_dog: bool = False,
    visitors: np.random.Generator | None = None,
    watch: Callable[[Policy], None] = lambda _: None,
) -> SessionTrajectories:
    """Simulate one session in a room; the same generator states give the same session.

    Where a dog lives too, the person films whom it looks at, one or both. ``visitors`` decides about another
    person, where one walks about. ``watch`` is called with the first animal after every step.
    """
    obstacles = room.obstacles()
    animal_floor, person_floor = floor_for(obstacles, ANIMAL_M), floor_for(obstacles, PERSON_M)
    start = person_floor.centers()[rng.integers(person_floor.free.sum())]
    animals = [Policy(animal_floor, room.places, _at_distance(animal_floor, start, 2.0, rng), rng)]
    if with_dog:
        dog_floor = floor_for(obstacles, (ANIMAL_M[0] * DOG.size, ANIMAL_M[1] * DOG.size))
        begin = _at_distance(dog_floor, animals[0].walker.position, 1.2, rng)
        animals.append(Companion(dog_floor, room.places, begin, rng))
    observer = Observer(person_floor, start, rng, style)
    phase = rng.uniform(0, 2 * np.pi) if with_dog else 0.0
    visitor = None if visitors is None else Visitor(person_floor, visitors)
    past: deque[tuple[list[SeenWalker], list[SeenWalker]]] = deque(maxlen=max(1, round(DELAY_S / STEP_S)))
    rows, person, reason, guest = [], [], [], []
    for index in range(steps(duration_s)):
        observer.step(STEP_S, companion.focus(animals, index * STEP_S, phase))
        walker = observer.walker
        people = [SeenWalker(walker.position.copy(), observer.velocity.copy())]
        if visitor is not None:
            visitor.step(STEP_S, walker.position)
            people.append(SeenWalker(visitor.walker.position.copy(), visitor.velocity.copy()))
            guest.append(visitor_row(visitor))
        past.append((people, [companion.seen(animal) for animal in animals]))
        companion.live(STEP_S, animals, *past[0])
        rows.append([course_row(animal) for animal in animals])
        person.append((walker.position.copy(), observer.looks_at.copy()))
        reason.append(REASONS.index(animals[0].reason))
        watch(animals[0])
    position, looks_at = (np.array(column) for column in zip(*person, strict=True))
    first, *others = (course_from_rows(course) for course in zip(*rows, strict=True))
    second, walked = others[0] if others else None, course_from_rows(guest) if guest else None
    return SessionTrajectories(first, position, looks_at, np.array(reason), second, walked)


def steps(duration_s: float) -> int:
    """Return the number of samples that cover a duration."""
    return int(np.ceil(duration_s / STEP_S)) + 2


def _at_distance(floor: Floor, start: Ground, distance_m: float, rng: np.random.Generator) -> Ground:
    centers = floor.centers()
    off = np.abs(np.linalg.norm(centers - start, axis=-1) - distance_m)
    return centers[np.argmin(off + rng.uniform(0, 0.5, len(centers)))]


CourseRow = tuple[np.ndarray, float, np.ndarray, float, np.ndarray, float]


def course_row(animal: Policy) -> CourseRow:
    """Return the animal's current state, for `course_from_rows`."""
    mood = {"flee": -0.9, "approach": 0.9, "own": 0.1}[animal.reason]
    tail, airborne = mood * (1.0 - 0.6 * animal.posture[:2].sum()), float(animal.leap is not None)
    return animal.position, animal.walker.yaw, animal.posture.copy(), airborne, animal.gaze.copy(), tail


def visitor_row(visitor: Visitor) -> CourseRow:
    """Return a visitor's current state, looking ahead, for `course_from_rows`."""
    (x, z), yaw = visitor.walker.position, visitor.walker.yaw
    gaze = np.array([x + 3 * np.sin(yaw), PERSON_M[1], z + 3 * np.cos(yaw)])
    return np.array([x, 0.0, z]), yaw, np.zeros(3), 0.0, gaze, 0.0


def course_from_rows(rows: Sequence[CourseRow]) -> AnimalCourse:
    """Stack rows of states at steps of `STEP_S`."""
    position, yaw, *others = (np.array(column) for column in zip(*rows, strict=True))
    return AnimalCourse(np.arange(len(rows)) * STEP_S, position, np.unwrap(yaw), *others)


def standing_course(room: Room, rng: np.random.Generator, duration_s: float) -> AnimalCourse:
    """Return the course of an animal that stands calmly on the rug, looking about now and then."""
    count = steps(duration_s)
    floor = floor_for(room.obstacles(), (1.0, PERSON_M[1]))
    spot = floor.nearest(np.array([0.55, 0.15]) + rng.uniform(-0.1, 0.1, 2))
    position = np.broadcast_to(np.array([spot[0], 0.008, spot[1]]), (count, 3)).copy()
    yaw = np.full(count, rng.uniform(-np.pi, np.pi))
    gaze = np.empty((count, 3))
    goal, current = None, None
    for index in range(count):
        if goal is None or rng.random() < STEP_S / 2.2:
            turn = yaw[0] + rng.normal(0, 0.35)
            goal = position[0] + np.array([np.sin(turn), 0.27 + rng.normal(0, 0.08), np.cos(turn)])
        current = goal if current is None else current + (goal - current) * (1 - np.exp(-STEP_S / 0.3))
        gaze[index] = current
    still = np.zeros(count)
    return AnimalCourse(np.arange(count) * STEP_S, position, yaw, 0 * gaze, still, gaze, still + 0.1)
