"""A person who walks through the room while it is filmed: a body on two legs, its clothes, and its paths."""

import numpy as np
from jaxtyping import Float

from stages.synthesize_capture.anatomy import Anatomy, BoneRow, Flesh, Gait, skeleton, tail_rows
from stages.synthesize_capture.navigation import Floor, Ground, Walker

TRUNK: list[BoneRow] = [
    ("pelvis", "spine", (0, -0.008, 0.0), (0, -0.022, 0.0), (0.035, 0.036)),
    ("spine", "loin", (0, 0.002, 0.0), (0, -0.008, 0.0), (0.032, 0.034)),
    ("loin", "", (0, 0.0, 0.0), (0, 0.03, 0.0), (0.031, 0.031)),
    ("chest", "loin", (0, 0.03, 0.0), (0, 0.104, 0.0), (0.033, 0.036)),
    ("neck", "chest", (0, 0.125, 0.0), (0, 0.15, 0.004), (0.016, 0.014)),
    ("head", "neck", (0, 0.163, 0.006), (0, 0.178, 0.008), (0.021, 0.022)),
    *tail_rows((0.0, -0.01, -0.005), (0.0, 0.0, -0.001), 0.0, (0.012, 0.01, 0.001)),
]
LEFT: list[BoneRow] = [
    ("upper arm", "chest", (0.052, 0.112, 0.0), (0.06, 0.045, -0.006), (0.015, 0.0125)),
    ("forearm", "upper arm", (0.06, 0.045, -0.006), (0.06, -0.012, 0.012), (0.0125, 0.0095)),
    ("hand", "forearm", (0.06, -0.012, 0.012), (0.058, -0.036, 0.02), (0.0105, 0.008)),
    ("thigh", "pelvis", (0.024, -0.015, 0.0), (0.026, -0.123, 0.006), (0.024, 0.016)),
    ("shank", "thigh", (0.026, -0.123, 0.006), (0.026, -0.222, -0.008), (0.016, 0.011)),
    ("foot", "shank", (0.026, -0.222, -0.008), (0.026, -0.2335, 0.022), (0.012, 0.0115)),
    ("toes", "foot", (0.026, -0.2335, 0.022), (0.026, -0.235, 0.044), (0.0115, 0.009)),
]
BELLY = Flesh((0.016, 0.02, 0.0), (-0.016, 0.02, 0.0), (0.03, 0.03), 0.02)
SHOULDERS = Flesh((0.04, 0.108, -0.002), (-0.04, 0.108, -0.002), (0.02, 0.02), 0.02)
SPEED_M_S, PAUSE_S = (0.6, 1.1), (0.5, 3.0)
"""Ranges of a visitor's walking speed and of its pauses."""
APART_M = 1.0
"""Minimum distance of a visitor from the filming person."""


def _dressed(
    vertices: Float[np.ndarray, "vertex 3"], rng: np.random.Generator
) -> Float[np.ndarray, "vertex 4"]:
    """Draw trousers, a striped shirt, shoes, skin and hair in random colors."""
    _, y, z = vertices.T
    trousers, shirt, stripe = (0.02 + 0.5 * rng.random(3) ** 2 for _ in range(3))
    skin, hair = np.array([0.5, 0.28, 0.19]) * rng.uniform(0.4, 1.2), np.array([0.09, 0.05, 0.03])
    color = np.where((y < 0.0)[:, None], trousers, shirt)
    striped = (y >= 0.0) & (np.sin(y / 0.004 + rng.uniform(0, 6)) > 0.4)
    color[striped] = stripe
    color[(y > 0.13) | ((np.abs(vertices[:, 0]) > 0.046) & (y < -0.006) & (y > -0.06))] = skin
    color[(y > 0.185) | ((y > 0.15) & (z < -0.002))] = hair
    color[y < -0.22] = 0.03
    return np.concatenate([color, np.full((len(vertices), 1), 0.2)], axis=-1).astype(np.float32)


PERSON = Anatomy(
    "person",
    skeleton(TRUNK, LEFT),
    (BELLY, SHOULDERS),
    _dressed,
    Gait(
        stand_m=0.258,
        sole_m=0.0125,
        forward=(0.0, 0.0),
        eye=(0.0, 0.17, 0.02),
        fold_m=0.1,
        flex=0.2,
        tail_sway=0.0,
        wings=True,
    ),
    size=3.9,
    box=((-0.085, 0.086), (-0.262, 0.215), (-0.06, 0.075)),
)
"""Bones as long as those of the animals', times 3.9: 1.74 m tall."""


class Visitor:
    """Walks from place to place with pauses, and keeps its distance from the filming person."""

    def __init__(self, floor: Floor, rng: np.random.Generator):
        self.rng, self.centers, self.pause_s = rng, floor.centers(), 0.0
        begin = self.centers[rng.integers(len(self.centers))]
        self.walker = Walker(floor, begin, rng.uniform(-np.pi, np.pi), turn_rate=2.6, acceleration=2.0)
        self.speed_m_s, self.velocity = rng.uniform(*SPEED_M_S), np.zeros(2)

    def step(self, seconds: float, observer: Ground) -> None:
        """Advance by one step, given the filming person's position."""
        before = self.walker.position.copy()
        if self.walker.arrived():
            self.pause_s -= seconds
        if np.linalg.norm(self.walker.position - observer) < APART_M or self.pause_s <= 0:
            off = np.linalg.norm(self.centers - observer, axis=-1)
            there = self.centers[off > APART_M + 0.3]
            self.walker.go(there[self.rng.integers(len(there))], avoid=observer)
            self.pause_s, self.speed_m_s = self.rng.uniform(*PAUSE_S), self.rng.uniform(*SPEED_M_S)
        self.walker.step(seconds, self.speed_m_s)
        self.velocity = (self.walker.position - before) / seconds
