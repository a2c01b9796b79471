"""Other homes than the one that is filmed: the same kinds of furniture along other walls, in another order.

`furnish_otherwise` draws a home until everything stands free and the animal can reach all of its favorite
places. Only `lives` needs them: behavior must be learned in some homes and judged in one that it has never
seen.
"""

from dataclasses import replace
from typing import cast

import numpy as np
from scipy.ndimage import label

from stages.synthesize_capture import furniture
from stages.synthesize_capture.furniture import Piece
from stages.synthesize_capture.navigation import ANIMAL_M, PERSON_M, floor_for
from stages.synthesize_capture.room import (
    DEPTH_M,
    WIDTH_M,
    WINDOW_CORNER,
    Place,
    Room,
    Standing,
    placed,
    shell,
)

GAP_M = 0.06
"""Gap between a wall and furniture."""
BREADTH_M = 0.5
"""Minimum free floor between two pieces, so that the animal can pass."""
IN_FRONT_OF_SOFA_M = 1.15
PLACES: dict[str, tuple[tuple[str, tuple[float, float, float], float, tuple[float, float]], ...]] = {
    "sofa": (
        ("sofa", (0.35, 0.44, 0.12), 0.0, (0.55, 0.86)),
        ("sofa corner", (-0.5, 0.44, 0.12), 0.3, (-0.7, 0.86)),
    ),
    "cat tree": (("cat tree", (-0.06, 0.5, 0.1), -0.6, (-0.1, 0.66)),),
    "shelf": (("shelf", (0.0, 0.0, 0.55), 0.0, (0.0, 0.55)),),
    "bowls": (("bowl", (0.05, 0.0, 0.35), np.pi, (0.05, 0.35)),),
    "window": (("window", (0.0, 0.0, 0.45), np.pi, (0.0, 0.45)),),
    "rug": (("rug", (0.0, 0.0, 0.0), 0.0, (0.0, 0.0)),),
}
"""Per piece, about its own origin: name, where the animal rests, where it looks, from where it jumps up."""
AT_WALLS = ("sofa", "shelf", "media", "cat tree", "dining table", "plant", "lamp", "bowls", "window")
WINDOW = Piece([], (1.5, 0.1), 2.1)
RUG = Piece([], (1.9, 1.35), 0.0)
ATTEMPTS = 500
"""Arrangements of a home that are tried; four times as many homes."""


def rearranged(home: Room, rng: np.random.Generator) -> Room:
    """Return a home with loose things moved, without trapping the animal."""
    for _ in range(ATTEMPTS):
        room = home.arranged(rng)
        if _livable(room):
            return room
    raise AssertionError("no livable arrangement")


def furnish_otherwise(rng: np.random.Generator) -> Room:
    """Draw homes until one is livable."""
    pieces = {name: make(rng) for name, make in furniture.MAKERS.items()} | {"window": WINDOW, "rug": RUG}
    things = furniture.loose_things(rng)
    for _ in range(4 * ATTEMPTS):
        standing = _arranged(pieces, rng)
        if standing is None:
            continue
        home = _home(standing, things, rng)
        if _livable(home):
            return home
    raise AssertionError("no livable home")


def filmed_elsewhere(rng: np.random.Generator) -> Room:
    """Draw a home with its own walls, window and prints, for filming."""
    home = furnish_otherwise(rng)
    return replace(home, fixed=(*shell(rng), *home.fixed), window=WINDOW_CORNER)


def _arranged(pieces: dict[str, Piece], rng: np.random.Generator) -> tuple[Standing, ...] | None:
    """Place the pieces at walls, largest first; None if one does not fit."""
    found: list[Standing] = []
    for name in sorted(AT_WALLS, key=lambda name: -pieces[name].size[0]):
        for _ in range(12):
            new = _at_wall(name, pieces[name], rng)
            if all(_apart(new, other) for other in found):
                found.append(new)
                break
        else:
            return None
        if name == "sofa":
            spot = new.at(rng.uniform(-0.2, 0.2), IN_FRONT_OF_SOFA_M)
            found.append(Standing("coffee table", pieces["coffee table"], *spot, new.yaw))
    rug = Standing(
        "rug", pieces["rug"], rng.uniform(-0.9, 0.9), rng.uniform(-0.5, 0.5), rng.choice([0.0, np.pi / 2])
    )
    return (*found, rug)


def _at_wall(name: str, piece: Piece, rng: np.random.Generator) -> Standing:
    wall = int(rng.integers(4))
    depth = piece.size[1] / 2 + GAP_M
    along = (WIDTH_M if wall % 2 == 0 else DEPTH_M) / 2 - piece.size[0] / 2 - 0.1
    offset, reach = rng.uniform(-along, along), (DEPTH_M if wall % 2 == 0 else WIDTH_M) / 2 - depth
    x, z, yaw = (
        (offset, -reach, 0.0),
        (-reach, offset, np.pi / 2),
        (offset, reach, np.pi),
        (reach, offset, -np.pi / 2),
    )[wall]
    return Standing(name, piece, float(x), float(z), float(yaw))


def _apart(first: Standing, second: Standing) -> bool:
    """Return whether two axis-aligned pieces leave a passage between them, or at least do not touch."""
    gap = 0.15 if {"window", "bowls", "plant", "lamp"} & {first.name, second.name} else BREADTH_M

    def half(thing: Standing) -> np.ndarray:
        size = np.array(thing.piece.size) / 2
        return size if abs(np.cos(thing.yaw)) > 0.5 else size[::-1]

    away = np.abs(np.array([first.x - second.x, first.z - second.z]))
    return bool((away > half(first) + half(second) + gap).any())


def _home(standing: tuple[Standing, ...], things: list[Piece], rng: np.random.Generator) -> Room:
    fixed = tuple(sheet for thing in standing for sheet in thing.sheets())
    window, lamp = (next(thing for thing in standing if thing.name == name) for name in ("window", "lamp"))
    corner = np.array([[window.x, 2.1, window.z], [0, 0, 1.5], [0, -1.2, 0]], float)
    home = Room(fixed, standing, (), _places(standing), corner, (lamp.x, 1.62, lamp.z))
    floor = floor_for(home.obstacles(), (0.9, PERSON_M[1])).centers()
    spots = np.column_stack(
        [floor[rng.integers(len(floor), size=len(things))], rng.uniform(-np.pi, np.pi, len(things))]
    )
    return replace(home, loose=placed(things, spots))


def _places(standing: tuple[Standing, ...]) -> tuple[Place, ...]:
    found = []
    for thing in standing:
        for name, (x, height, z), yaw, entry in PLACES.get(thing.name, ()):
            spot = thing.at(x, z)
            found.append(Place(name, (spot[0], height, spot[1]), thing.yaw + yaw, thing.at(*entry)))
    return tuple(found)


def _livable(room: Room) -> bool:
    """Return whether the free floor is connected for animal and person and reaches all favorite places."""
    for size_m in (ANIMAL_M, PERSON_M):
        floor = floor_for(room.obstacles(), size_m)
        parts, count = cast("tuple[np.ndarray, int]", label(floor.free))
        sizes = np.bincount(parts.ravel())[1:]
        if not count or sizes.max() < 0.93 * sizes.sum() or floor.free.mean() < 0.3:
            return False
        if size_m == ANIMAL_M:
            largest = 1 + int(np.argmax(sizes))
            if any(parts[floor.cell(np.asarray(place.entry))] != largest for place in room.places):
                return False
    return True
