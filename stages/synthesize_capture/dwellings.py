"""Other homes than the one that is filmed: the same kinds of furniture along other walls, in another order.

`furnish_otherwise` draws a home until everything stands free and the animal can reach all of its favourite
places. Only `lives` needs them: behaviour must be learned in some homes and judged in one that it has never
seen.
"""

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy.ndimage import label

from stages.synthesize_capture import furniture, sheets
from stages.synthesize_capture.furniture import Piece
from stages.synthesize_capture.navigation import floor_for
from stages.synthesize_capture.room import (
    DEPTH_M,
    WIDTH_M,
    WINDOW_CORNER,
    Footprint,
    Movable,
    Place,
    Room,
    shell,
)
from stages.synthesize_capture.session import (
    ANIMAL_BREADTH_M,
    ANIMAL_HEIGHT_M,
    PERSON_BREADTH_M,
    PERSON_HEIGHT_M,
)

GAP_M = 0.06
"""Between a wall and what stands at it."""
BREADTH_M = 0.5
"""Free floor wanted between two pieces, so that the animal passes."""
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


@dataclass(frozen=True)
class Standing:
    """A piece of furniture that has its place in a home."""

    name: str
    piece: Piece
    x: float
    z: float
    yaw: float

    def footprint(self) -> Footprint:
        """Return the block that it takes."""
        return Footprint((self.x, self.z), self.piece.size, self.yaw, self.piece.bottom, self.piece.top)

    def at(self, x: float, z: float) -> tuple[float, float]:
        """Return the floor point that lies at (x, z) from its origin, in its own axes."""
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        return float(self.x + cosine * x + sine * z), float(self.z - sine * x + cosine * z)


@dataclass(frozen=True)
class Dwelling:
    """A home to live in: the room as the animal and the person meet it, and what stands where."""

    room: Room
    standing: tuple[Standing, ...]
    """Furniture, the rug, the window and, last, the loose things."""

    def rearranged(self, rng: np.random.Generator, attempts: int = 500) -> "Dwelling":
        """Return the home after people moved its loose things, none of them so that it shuts the animal
        in.
        """
        for _ in range(attempts):
            room = self.room.arranged(rng)
            if _livable(room):
                return Dwelling(room, (*self.standing[: -len(room.movables)], *_loose(room)))
        raise AssertionError(f"no livable arrangement in {attempts} attempts")


def furnish_otherwise(rng: np.random.Generator, attempts: int = 2000) -> Dwelling:
    """Draw homes until one can be lived in."""
    pieces = {name: make(rng) for name, make in furniture.MAKERS.items()} | {"window": WINDOW, "rug": RUG}
    things = furniture.loose_things(rng)
    for _ in range(attempts):
        standing = _arranged(pieces, rng)
        if standing is None:
            continue
        home = _home(standing, things, rng)
        if _livable(home.room):
            return home
    raise AssertionError(f"no livable home in {attempts} attempts")


def filmed_elsewhere(rng: np.random.Generator) -> Room:
    """Draw a home with walls, window and prints of its own, to be filmed."""
    home = furnish_otherwise(rng).room
    return replace(home, fixed=(*shell(rng), *home.fixed), window=WINDOW_CORNER)


def _arranged(pieces: dict[str, Piece], rng: np.random.Generator) -> tuple[Standing, ...] | None:
    """Put the pieces at walls, largest first, each where it has room; None where one finds none."""
    placed: list[Standing] = []
    for name in sorted(AT_WALLS, key=lambda name: -pieces[name].size[0]):
        for _ in range(12):
            new = _at_wall(name, pieces[name], rng)
            if all(_apart(new, other) for other in placed):
                placed.append(new)
                break
        else:
            return None
        if name == "sofa":
            table = Standing(
                "coffee table",
                pieces["coffee table"],
                *new.at(rng.uniform(-0.2, 0.2), IN_FRONT_OF_SOFA_M),
                new.yaw,
            )
            placed.append(table)
    rug = Standing(
        "rug", pieces["rug"], rng.uniform(-0.9, 0.9), rng.uniform(-0.5, 0.5), rng.choice([0.0, np.pi / 2])
    )
    return (*placed, rug)


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
    """Tell whether two pieces, which stand along the axes, leave a way between them, or at least touch
    nowhere.
    """
    gap = 0.15 if {"window", "bowls", "plant", "lamp"} & {first.name, second.name} else BREADTH_M

    def half(thing: Standing) -> np.ndarray:
        size = np.array(thing.piece.size) / 2
        return size if abs(np.cos(thing.yaw)) > 0.5 else size[::-1]

    away = np.abs(np.array([first.x - second.x, first.z - second.z]))
    return bool((away > half(first) + half(second) + gap).any())


def _home(standing: tuple[Standing, ...], things: list[Piece], rng: np.random.Generator) -> Dwelling:
    fixed = [sheet.moved(sheets.upright(s.x, s.z, s.yaw)) for s in standing for sheet in s.piece.sheets]
    blocks = tuple(s.footprint() for s in standing if s.piece.top > 0.1 and s.name != "window")
    floor = floor_for(list(blocks), breadth_m=0.9, height_m=PERSON_HEIGHT_M).centers()
    homes = np.column_stack(
        [floor[rng.integers(len(floor), size=len(things))], rng.uniform(-np.pi, np.pi, len(things))]
    )
    movables = tuple(
        Movable(tuple(t.sheets), t.size, t.top, (x, z, yaw))
        for t, (x, z, yaw) in zip(things, homes.tolist(), strict=True)
    )
    window = next(s for s in standing if s.name == "window")
    corner = np.array([[window.x, 2.1, window.z], [0, 0, 1.5], [0, -1.2, 0]], float)
    lamp = next(s for s in standing if s.name == "lamp")
    room = Room(tuple(fixed), movables, homes, blocks, _places(standing), corner, (lamp.x, 1.62, lamp.z))
    return Dwelling(room, (*standing, *_loose(room)))


def _places(standing: tuple[Standing, ...]) -> tuple[Place, ...]:
    found = []
    for thing in standing:
        for name, (x, height, z), yaw, entry in PLACES.get(thing.name, ()):
            spot = thing.at(x, z)
            found.append(Place(name, (spot[0], height, spot[1]), thing.yaw + yaw, thing.at(*entry)))
    return tuple(found)


def _loose(room: Room) -> tuple[Standing, ...]:
    pieces = [Piece(list(thing.sheets), thing.size, thing.height) for thing in room.movables]
    return tuple(
        Standing("loose", piece, *map(float, spot))
        for piece, spot in zip(pieces, room.arrangement, strict=True)
    )


def _livable(room: Room) -> bool:
    """Tell whether nearly all free floor hangs together, for animal and person, with all favourite places on
    it.
    """
    for breadth, height in ((ANIMAL_BREADTH_M, ANIMAL_HEIGHT_M), (PERSON_BREADTH_M, PERSON_HEIGHT_M)):
        floor = floor_for(room.footprints(), breadth_m=breadth, height_m=height)
        parts, count = cast("tuple[np.ndarray, int]", label(floor.free))
        sizes = np.bincount(parts.ravel())[1:]
        if not count or sizes.max() < 0.93 * sizes.sum() or floor.free.mean() < 0.3:
            return False
        if breadth == ANIMAL_BREADTH_M:
            largest = 1 + int(np.argmax(sizes))
            if any(parts[floor.cell(np.asarray(place.entry))] != largest for place in room.places):
                return False
    return True
