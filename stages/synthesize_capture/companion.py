"""A second animal: a dog that plays with the first one, follows it and leaves it alone in turn.

`live` moves one or two animals on, `focus` is what the person films.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from stages.synthesize_capture.navigation import Floor, Ground
from stages.synthesize_capture.policy import Policy, SeenWalker
from stages.synthesize_capture.room import Place

Mode = Literal["own", "follow", "play", "avoid"]
NEXT: dict[Mode, tuple[tuple[Mode, ...], tuple[float, ...]]] = {
    "own": (("follow", "play"), (0.6, 0.4)),
    "follow": (("play", "own", "avoid"), (0.4, 0.3, 0.3)),
    "play": (("avoid", "follow", "own"), (0.5, 0.25, 0.25)),
    "avoid": (("own", "follow"), (0.5, 0.5)),
}
"""Successors of each mode with their probabilities."""
LASTING_S: dict[Mode, tuple[float, float]] = {
    mode: (4.0, 8.0) if mode == "follow" else (2.0, 4.0) for mode in NEXT
}
PACE_M_S: dict[Mode, float] = {"own": 0.7, "follow": 0.9, "play": 1.5, "avoid": 1.2}
REACH_M: dict[Mode, float] = {"follow": 0.95, "play": 0.75}
"""Distance to which it approaches the other, center to center."""
PLANNED_S = 0.4
"""Interval of replanning."""
APART_M, PUSH_M_S = 0.62, 1.2
"""Minimum distance of two bodies on the floor, and the speed at which they separate."""
REACTION_M = 1.0
"""Distance below which the cat reacts to the dog."""
FOCUS_PERIOD_S, BOTH_M = 9.0, 1.5
"""Period of alternating between the animals, and distance below which both are filmed."""


class Companion(Policy):
    """A dog's decisions: it stays on the floor and reacts to the other animal."""

    def __init__(self, floor: Floor, places: tuple[Place, ...], position: Ground, rng: np.random.Generator):
        low = tuple(place for place in places if place.position[1] < 0.1)
        super().__init__(floor, low, position, rng)
        self.mode: Mode = "follow"
        self.left_s, self.planned_s = rng.uniform(1.0, 3.0), 0.0
        self.other = SeenWalker(self.walker.position, np.zeros(2))

    def _decide(self, seconds: float, seen: SeenWalker) -> None:
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


def live(
    seconds: float, animals: list[Policy], people: Sequence[SeenWalker], others: Sequence[SeenWalker]
) -> None:
    """Move the animals on by one step, given people and animals as they notice them now: of people, they
    react to the nearest.
    """
    match animals:
        case [animal]:
            animal.step(seconds, _nearest(animal, people))
        case [cat, Companion() as dog]:
            cat.step(seconds, _reacts_to(cat, _nearest(cat, people), others[1]))
            dog.other = others[0]
            dog.step(seconds, _nearest(dog, people))
            _keep_apart(seconds, cat, dog)


def seen(animal: Policy) -> SeenWalker:
    """Return an animal as others see it."""
    walker = animal.walker
    velocity = walker.speed * np.array([np.sin(walker.yaw), np.cos(walker.yaw)])
    return SeenWalker(walker.position.copy(), velocity)


def _nearest(animal: Policy, people: Sequence[SeenWalker]) -> SeenWalker:
    return min(people, key=lambda each: float(np.linalg.norm(each.position - animal.walker.position)))


def _reacts_to(cat: Policy, person: SeenWalker, dog: SeenWalker) -> SeenWalker:
    """Return whom the cat reacts to: the dog if it is near and nearer than the person."""
    apart = [float(np.linalg.norm(each.position - cat.walker.position)) for each in (person, dog)]
    return dog if apart[1] < min(REACTION_M, apart[0]) else person


def _keep_apart(seconds: float, cat: Policy, dog: Companion) -> None:
    """Separate bodies on the floor: move the dog, or the cat if the dog is blocked."""
    if cat.height > 0.1 or cat.leap is not None:
        return
    off = dog.walker.position - cat.walker.position
    distance = float(np.linalg.norm(off))
    if distance >= APART_M:
        return
    way = off / distance if distance > 1e-6 else np.array([1.0, 0.0])
    step = min(APART_M - distance, PUSH_M_S * seconds)
    for animal, sign in ((dog, 1.0), (cat, -1.0)):
        goal = animal.walker.position + sign * step * way
        if animal.walker.floor.is_free(goal):
            animal.walker.position = goal
            return


def focus(animals: list[Policy], now_s: float, phase: float) -> Float[np.ndarray, "3"]:
    """Return what the person films: the midpoint of two animals near each other, else them in turn."""
    if len(animals) == 1:
        return animals[0].position
    cat, dog = animals
    apart = float(np.linalg.norm(cat.position - dog.position))
    turn = 0.5 + 0.5 * np.tanh(3 * np.sin(2 * np.pi * now_s / FOCUS_PERIOD_S + phase))
    both = np.clip((BOTH_M + 0.4 - apart) / 0.4, 0, 1)
    share = 0.5 * both + turn * (1 - both)
    return cat.position + share * (dog.position - cat.position)
