"""The home: one furnished living room as sheets, footprints, favorite places and lights.

`furnish` builds it from a generator: walls with faint plaster, a repeating plank floor, and strong features
only where homes have them. `Room.arranged` puts the movable things somewhere else for another session. Frame:
the world of the truth, +y up, floor at y = 0, meters; x along the long side, z along the short one. The
pieces of `furniture.py` stand about their own origins with their backs to -z; `furnish` puts them up.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from stages.synthesize_capture import furniture
from stages.synthesize_capture.furniture import Piece
from stages.synthesize_capture.sheets import Sheet, box, curtain, cylinder, flat, upright
from stages.synthesize_capture.texture import fabric, plain, planks, poster, rug, view, wood

WIDTH_M, DEPTH_M, HEIGHT_M = 6.0, 4.8, 2.5
X, Y, Z = WIDTH_M / 2, HEIGHT_M, DEPTH_M / 2
WINDOW_CORNER = np.array([[X - 0.02, 2.1, -0.75], [0, 0, 1.5], [0, -1.2, 0]], float)
"""top left corner of the window, its right edge and its down edge"""
WALLS = (
    ((-X, Y, -Z), (2 * X, 0, 0), (0, -Y, 0)),
    ((X, Y, Z), (-2 * X, 0, 0), (0, -Y, 0)),
    ((-X, Y, Z), (0, 0, -2 * Z), (0, -Y, 0)),
    ((X, Y, -Z), (0, 0, 2 * Z), (0, -Y, 0)),
)
FLOOR = ((-X, 0, -Z), (2 * X, 0, 0), (0, 0, 2 * Z))
"""top left corner, right edge and down edge of each wall and of the floor, as seen from the room"""


@dataclass(frozen=True)
class Standing:
    """A piece of furniture at its place: origin on the floor, heading about +y."""

    name: str
    piece: Piece
    x: float
    z: float
    yaw: float

    def at(self, x: float, z: float) -> tuple[float, float]:
        """Return the floor point at (x, z) in its own axes."""
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        return float(self.x + cosine * x + sine * z), float(self.z - sine * x + cosine * z)

    def axis_distance(
        self, x: Float[np.ndarray, "*batch"], z: Float[np.ndarray, "*batch"]
    ) -> Float[np.ndarray, "*batch 2"]:
        """Return how far floor points are from its origin along its own axes, meters."""
        cosine, sine, x, z = np.cos(self.yaw), np.sin(self.yaw), x - self.x, z - self.z
        return np.abs(np.stack([cosine * x - sine * z, sine * x + cosine * z], axis=-1))

    def sheets(self) -> list[Sheet]:
        """Return its sheets in world axes."""
        return [sheet.moved(upright(self.x, self.z, self.yaw)) for sheet in self.piece.sheets]


@dataclass(frozen=True)
class Place:
    """A place the animal likes: where it stands, which way it looks, from where on the floor it jumps up."""

    name: str
    position: tuple[float, float, float]
    yaw: float
    entry: tuple[float, float]


@dataclass(frozen=True)
class Room:
    """A furnished room in one arrangement."""

    fixed: tuple[Sheet, ...]
    """What people do not move, world axes."""
    standing: tuple[Standing, ...]
    """What `fixed` shows of furniture."""
    loose: tuple[Standing, ...]
    """What people move between sessions."""
    places: tuple[Place, ...]
    window: Float[np.ndarray, "corner 3"]
    """Top left corner, right edge, down edge of the window as seen from the room."""
    lamp: tuple[float, float, float]

    def sheets(self) -> list[Sheet]:
        """Return every sheet in world axes."""
        return [*self.fixed, *(sheet for thing in self.loose for sheet in thing.sheets())]

    def obstacles(self) -> list[Standing]:
        """Return all obstacles."""
        return [
            *(thing for thing in self.standing if thing.piece.top > 0.1 and thing.name != "window"),
            *self.loose,
        ]

    def arranged(self, rng: np.random.Generator) -> "Room":
        """Return the room after people moved its loose things: each shifted and turned, some a good way."""
        spots = np.array([(thing.x, thing.z, thing.yaw) for thing in self.loose], float)
        far = rng.random(len(spots)) < 0.6
        spots[:, :2] += np.where(far, 0.45, 0.08)[:, None] * rng.uniform(-1, 1, (len(spots), 2))
        spots[:, 2] += np.where(far, 1.2, 0.1) * rng.uniform(-1, 1, len(spots))
        reach = np.array([WIDTH_M, DEPTH_M]) / 2 - 0.3
        spots[:, :2] = np.clip(spots[:, :2], -reach, reach)
        return replace(self, loose=placed([thing.piece for thing in self.loose], spots))


def placed(
    things: Sequence[Piece], spots: Float[np.ndarray, "thing 3"] | Sequence[Sequence[float]]
) -> tuple[Standing, ...]:
    """Put loose things at their x, z, yaw."""
    return tuple(
        Standing("loose", thing, *map(float, spot)) for thing, spot in zip(things, spots, strict=True)
    )


def furnish(rng: np.random.Generator) -> Room:
    """Build the room with its usual arrangement; the generator gives colors, prints and small offsets."""
    stands = {
        "sofa": (-0.75, -Z + 0.5, 0.0),
        "shelf": (-X + 0.18, 0.65, np.pi / 2),
        "media": (-0.8, Z - 0.22, np.pi),
        "cat tree": (X - 0.42, -Z + 0.42, 0.0),
        "coffee table": (-0.8, -Z + 1.62, 0.0),
        "dining table": (X - 0.62, Z - 0.62, 0.0),
        "plant": (-X + 0.36, -Z + 0.38, 0.0),
        "lamp": (0.85, -Z + 0.26, 0.0),
        "bowls": (1.45, Z - 0.22, 0.0),
    }
    stands = {
        name: (x + rng.uniform(-0.06, 0.06) * (yaw == 0), z + rng.uniform(-0.06, 0.06) * (yaw != 0), yaw)
        for name, (x, z, yaw) in stands.items()
    }
    standing = tuple(Standing(name, furniture.MAKERS[name](rng), *spot) for name, spot in stands.items())
    fixed = [*shell(rng), *(sheet for thing in standing for sheet in thing.sheets())]
    loose, lamp = placed(furniture.loose_things(rng), HOMES), (stands["lamp"][0], 1.62, stands["lamp"][1])
    return Room(tuple(fixed), standing, loose, _places(stands), WINDOW_CORNER, lamp)


HOMES = (
    (1.5, 1.5, 0.9),
    (2.45, 0.62, 0.3),
    (-2.55, 1.95, -0.4),
    (1.1, -1.0, 0.0),
    (-0.3, 1.1, 0.7),
    (0.5, -1.75, 0.0),
)
"""Usual x, z, yaw of chair, crate, parcel, two balls and stool."""


def _places(stands: dict[str, tuple[float, float, float]]) -> tuple[Place, ...]:
    """Return the animal's favorite places, from where the furniture stands."""
    sofa, tree, bowls, shelf = (stands[name] for name in ("sofa", "cat tree", "bowls", "shelf"))
    return (
        Place("sofa", (sofa[0] + 0.35, 0.44, sofa[1] + 0.12), 0.0, (sofa[0] + 0.55, sofa[1] + 0.86)),
        Place("sofa corner", (sofa[0] - 0.5, 0.44, sofa[1] + 0.12), 0.3, (sofa[0] - 0.7, sofa[1] + 0.86)),
        Place("bowl", (bowls[0] - 0.05, 0.0, bowls[1] - 0.2), 0.0, (bowls[0] - 0.05, bowls[1] - 0.2)),
        Place("window", (X - 0.45, 0.0, 0.0), np.pi / 2, (X - 0.45, 0.0)),
        Place("rug", (0.6, 0.0, 0.2), -np.pi / 2, (0.6, 0.2)),
        Place("cat tree", (tree[0] - 0.06, 0.5, tree[1] + 0.1), -0.6, (tree[0] - 0.54, tree[1] + 0.54)),
        Place("shelf", (shelf[0] + 0.55, 0.0, shelf[1]), np.pi / 2, (shelf[0] + 0.55, shelf[1])),
    )


def shell(rng: np.random.Generator) -> list[Sheet]:
    """Build floor, ceiling and walls with their window and prints."""
    return [*_walls(rng), *_window(rng), *_prints(rng)]


def _walls(rng: np.random.Generator) -> list[Sheet]:
    wall = np.array([206.0, 200, 188]) + rng.uniform(-10, 10, 3)
    accent = np.array([150.0, 168, 172]) + rng.uniform(-14, 14, 3)
    plaster, strong = plain(rng, tuple(wall)), plain(rng, tuple(accent))
    ceiling = plain(rng, (226, 224, 218), clouds=1.5)
    paints = plaster, plaster, strong, plaster, planks(rng, (158, 122, 86))
    walls = [flat(*edges, paint) for edges, paint in zip((*WALLS, FLOOR), paints, strict=True)]
    walls.append(flat((-X, Y, Z), (2 * X, 0, 0), (0, 0, -2 * Z), ceiling))
    skirting = plain(rng, (224, 220, 210))
    board = [
        *box((0, 0.04, -Z + 0.008), (2 * X, 0.08, 0.016), skirting, skip="-y -z +x -x"),
        *box((0, 0.04, Z - 0.008), (2 * X, 0.08, 0.016), skirting, skip="-y +z +x -x"),
        *box((-X + 0.008, 0.04, 0), (0.016, 0.08, 2 * Z), skirting, skip="-y -x +z -z"),
        *box((X - 0.008, 0.04, 0), (0.016, 0.08, 2 * Z), skirting, skip="-y +x +z -z"),
    ]
    door = wood(rng, (196, 184, 164), contrast=3)
    frame = plain(rng, (228, 226, 220))
    leaf = box((1.0, 1.0, Z - 0.02), (0.8, 2.0, 0.03), door, skip="+z -y")
    around = [
        *box((0.56, 1.02, Z - 0.03), (0.07, 2.04, 0.06), frame, skip="+z -y"),
        *box((1.44, 1.02, Z - 0.03), (0.07, 2.04, 0.06), frame, skip="+z -y"),
    ]
    handle = box((0.71, 1.0, Z - 0.06), (0.12, 0.02, 0.05), plain(rng, (90, 88, 84)))
    panel = wood(rng, (186, 172, 150), contrast=3)
    panels = [
        *box((1.0, 0.55, Z - 0.042), (0.56, 0.7, 0.014), panel, skip="+z"),
        *box((1.0, 1.45, Z - 0.042), (0.56, 0.7, 0.014), panel, skip="+z"),
    ]
    return [*walls, *board, *leaf, *around, *handle, *panels]


def _window(rng: np.random.Generator) -> list[Sheet]:
    cloth = fabric(rng, (122, 74, 62), grain=5, stripes_m=0.11, stripe=9)
    white, clay, soil = (plain(rng, color) for color in ((220, 220, 214), (176, 92, 60), (60, 46, 36)))
    corner, right, down = WINDOW_CORNER
    parts = [flat(corner, right, down, view(rng), glow=1.0)]
    parts += box((X - 0.09, 0.88, 0), (0.18, 0.04, 1.62), plain(rng, (228, 226, 222)), skip="+x")
    for z in (-1.18, 0.68):
        parts.append(curtain((X - 0.1, 2.28, z), (0, 0, 0.5), 2.2, cloth, depth=0.035, folds=5))
    for k in range(12):
        parts += box((X - 0.07, 0.42, -0.55 + 0.1 * k), (0.09, 0.6, 0.07), white, skip="+x -y")
    return parts + cylinder((X - 0.1, 0.97, 0.45), 0.06, 0.13, clay, soil, flare=1.25)


def _prints(rng: np.random.Generator) -> list[Sheet]:
    x, z = X - 0.012, Z - 0.012
    return [
        flat((-0.4, 0.008, -0.5), (1.9, 0, 0), (0, 0, 1.35), rug(rng)),
        flat((-1.6, 1.95, -z), (0.6, 0, 0), (0, -0.8, 0), poster(rng)),
        flat((-0.75, 1.85, -z), (0.4, 0, 0), (0, -0.5, 0), poster(rng)),
        flat((1.4, 1.9, -z), (0.5, 0, 0), (0, -0.7, 0), poster(rng)),
        flat((-x, 1.8, -0.45), (0, 0, -0.7), (0, -0.5, 0), poster(rng)),
        flat((-x, 1.75, 2.05), (0, 0, -0.45), (0, -0.6, 0), poster(rng)),
        flat((2.6, 1.75, z), (-0.55, 0, 0), (0, -0.42, 0), poster(rng)),
        flat((x, 1.8, 1.45), (0, 0, 0.4), (0, -0.5, 0), poster(rng)),
    ]
