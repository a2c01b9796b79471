"""The home: one furnished living room as sheets, footprints, favourite places and lights.

`furnish` builds it from a generator: walls with faint plaster, a repeating plank floor, and strong features
only where homes have them. `Room.arranged` puts the movable things somewhere else for another session. Frame:
the world of the truth, +y up, floor at y = 0, metres; x along the long side, z along the short one. The
pieces of `furniture.py` stand about their own origins with their backs to -z; `furnish` puts them up.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from stages.synthesize_capture import furniture, sheets, texture
from stages.synthesize_capture.sheets import Sheet

WIDTH_M, DEPTH_M, HEIGHT_M = 6.0, 4.8, 2.5
WINDOW_CORNER = np.array([[WIDTH_M / 2 - 0.02, 2.1, -0.75], [0, 0, 1.5], [0, -1.2, 0]], float)
"""top left corner of the window, its right edge and its down edge"""


@dataclass(frozen=True)
class Footprint:
    """A block that stands in the way: centre (x, z), size (x, z) before the turn about +y, height span."""

    center: tuple[float, float]
    size: tuple[float, float]
    yaw: float = 0.0
    bottom: float = 0.0
    top: float = 1.0


@dataclass(frozen=True)
class Place:
    """A place the animal likes: where it stands, which way it looks, the spot on the floor from which it
    jumps up.
    """

    name: str
    position: tuple[float, float, float]
    yaw: float
    entry: tuple[float, float]


@dataclass(frozen=True)
class Movable:
    """A thing that people move between sessions; sheets and footprint about its own origin."""

    sheets: tuple[Sheet, ...]
    size: tuple[float, float]
    height: float
    home: tuple[float, float, float]
    """Usual x, z, yaw."""


@dataclass(frozen=True)
class Room:
    """A furnished room in one arrangement."""

    fixed: tuple[Sheet, ...]
    movables: tuple[Movable, ...]
    arrangement: Float[np.ndarray, "movable 3"]
    """x, z, yaw of each movable."""
    standing: tuple[Footprint, ...]
    places: tuple[Place, ...]
    window: Float[np.ndarray, "corner 3"]
    """Top left corner, right edge, down edge of the window as seen from the room."""
    lamp: tuple[float, float, float]

    def sheets(self) -> list[Sheet]:
        """Return every sheet in world axes."""
        moved = [
            sheet.moved(sheets.upright(x, z, yaw))
            for thing, (x, z, yaw) in zip(self.movables, self.arrangement, strict=True)
            for sheet in thing.sheets
        ]
        return [*self.fixed, *moved]

    def footprints(self) -> list[Footprint]:
        """Return everything that stands in the way."""
        moved = [
            Footprint((x, z), thing.size, yaw, 0.0, thing.height)
            for thing, (x, z, yaw) in zip(self.movables, self.arrangement, strict=True)
        ]
        return [*self.standing, *moved]

    def arranged(self, rng: np.random.Generator) -> "Room":
        """Return the room after people moved its loose things: each is shifted and turned, some a good
        way.
        """
        arrangement = np.array([thing.home for thing in self.movables], float)
        far = rng.random(len(arrangement)) < 0.6
        reach = np.where(far, 0.45, 0.08)[:, None]
        arrangement[:, :2] += reach * rng.uniform(-1, 1, (len(arrangement), 2))
        arrangement[:, 2] += np.where(far, 1.2, 0.1) * rng.uniform(-1, 1, len(arrangement))
        arrangement[:, 0] = np.clip(arrangement[:, 0], -WIDTH_M / 2 + 0.3, WIDTH_M / 2 - 0.3)
        arrangement[:, 1] = np.clip(arrangement[:, 1], -DEPTH_M / 2 + 0.3, DEPTH_M / 2 - 0.3)
        return replace(self, arrangement=arrangement)


def furnish(rng: np.random.Generator) -> Room:
    """Build the room with its usual arrangement; colours, prints and small offsets come from the
    generator.
    """
    x, z = WIDTH_M / 2, DEPTH_M / 2
    stands = {
        "sofa": (-0.75, -z + 0.5, 0.0),
        "shelf": (-x + 0.18, 0.65, np.pi / 2),
        "media": (-0.8, z - 0.22, np.pi),
        "cat tree": (x - 0.42, -z + 0.42, 0.0),
        "coffee table": (-0.8, -z + 1.62, 0.0),
        "dining table": (x - 0.62, z - 0.62, 0.0),
        "plant": (-x + 0.36, -z + 0.38, 0.0),
        "lamp": (0.85, -z + 0.26, 0.0),
        "bowls": (1.45, z - 0.22, 0.0),
    }
    stands = {
        name: (px + rng.uniform(-0.06, 0.06) * (yaw == 0), pz + rng.uniform(-0.06, 0.06) * (yaw != 0), yaw)
        for name, (px, pz, yaw) in stands.items()
    }
    pieces = {name: furniture.MAKERS[name](rng) for name in stands}
    fixed = shell(rng)
    fixed += [
        sheet.moved(sheets.upright(*stands[name])) for name, piece in pieces.items() for sheet in piece.sheets
    ]
    standing = tuple(
        Footprint((px, pz), pieces[name].size, yaw, pieces[name].bottom, pieces[name].top)
        for name, (px, pz, yaw) in stands.items()
        if pieces[name].top > 0.1
    )
    movables = tuple(
        Movable(tuple(piece.sheets), piece.size, piece.top, home)
        for piece, home in zip(furniture.loose_things(rng), _HOMES, strict=True)
    )
    lamp = (stands["lamp"][0], 1.62, stands["lamp"][1])
    return Room(
        tuple(fixed), movables, np.array(_HOMES, float), standing, _places(stands), WINDOW_CORNER, lamp
    )


_HOMES = (
    (1.5, 1.5, 0.9),
    (2.45, 0.62, 0.3),
    (-2.55, 1.95, -0.4),
    (1.1, -1.0, 0.0),
    (-0.3, 1.1, 0.7),
    (0.5, -1.75, 0.0),
)
"""Usual x, z, yaw of chair, crate, parcel, two balls and stool."""


def _places(stands: dict[str, tuple[float, float, float]]) -> tuple[Place, ...]:
    """Return the animal's favourite places, from where the furniture stands."""
    sofa, tree, bowls, shelf = (stands[name] for name in ("sofa", "cat tree", "bowls", "shelf"))
    return (
        Place("sofa", (sofa[0] + 0.35, 0.44, sofa[1] + 0.12), 0.0, (sofa[0] + 0.55, sofa[1] + 0.86)),
        Place("sofa corner", (sofa[0] - 0.5, 0.44, sofa[1] + 0.12), 0.3, (sofa[0] - 0.7, sofa[1] + 0.86)),
        Place("bowl", (bowls[0] - 0.05, 0.0, bowls[1] - 0.2), 0.0, (bowls[0] - 0.05, bowls[1] - 0.2)),
        Place("window", (WIDTH_M / 2 - 0.45, 0.0, 0.0), np.pi / 2, (WIDTH_M / 2 - 0.45, 0.0)),
        Place("rug", (0.6, 0.0, 0.2), -np.pi / 2, (0.6, 0.2)),
        Place("cat tree", (tree[0] - 0.06, 0.5, tree[1] + 0.1), -0.6, (tree[0] - 0.54, tree[1] + 0.54)),
        Place("shelf", (shelf[0] + 0.55, 0.0, shelf[1]), np.pi / 2, (shelf[0] + 0.55, shelf[1])),
    )


def shell(rng: np.random.Generator) -> list[Sheet]:
    """Build floor, ceiling and walls with their window and prints."""
    return [*_shell(rng), *_window(rng), *_prints(rng)]


def _shell(rng: np.random.Generator) -> list[Sheet]:
    x, y, z = WIDTH_M / 2, HEIGHT_M, DEPTH_M / 2
    wall = np.array([206.0, 200, 188]) + rng.uniform(-10, 10, 3)
    accent = np.array([150.0, 168, 172]) + rng.uniform(-14, 14, 3)
    plaster, strong = texture.plain(rng, tuple(wall)), texture.plain(rng, tuple(accent))
    walls = [
        sheets.flat((-x, y, -z), (2 * x, 0, 0), (0, -y, 0), plaster),
        sheets.flat((x, y, z), (-2 * x, 0, 0), (0, -y, 0), plaster),
        sheets.flat((-x, y, z), (0, 0, -2 * z), (0, -y, 0), strong),
        sheets.flat((x, y, -z), (0, 0, 2 * z), (0, -y, 0), plaster),
        sheets.flat((-x, 0, -z), (2 * x, 0, 0), (0, 0, 2 * z), texture.planks(rng, (158, 122, 86))),
        sheets.flat(
            (-x, y, z), (2 * x, 0, 0), (0, 0, -2 * z), texture.plain(rng, (226, 224, 218), clouds=1.5)
        ),
    ]
    skirting = texture.plain(rng, (224, 220, 210))
    board = [
        *sheets.box((0, 0.04, -z + 0.008), (2 * x, 0.08, 0.016), skirting, skip="-y -z +x -x"),
        *sheets.box((0, 0.04, z - 0.008), (2 * x, 0.08, 0.016), skirting, skip="-y +z +x -x"),
        *sheets.box((-x + 0.008, 0.04, 0), (0.016, 0.08, 2 * z), skirting, skip="-y -x +z -z"),
        *sheets.box((x - 0.008, 0.04, 0), (0.016, 0.08, 2 * z), skirting, skip="-y +x +z -z"),
    ]
    door = texture.wood(rng, (196, 184, 164), contrast=3)
    frame = texture.plain(rng, (228, 226, 220))
    leaf = sheets.box((1.0, 1.0, z - 0.02), (0.8, 2.0, 0.03), door, skip="+z -y")
    around = [
        *sheets.box((0.56, 1.02, z - 0.03), (0.07, 2.04, 0.06), frame, skip="+z -y"),
        *sheets.box((1.44, 1.02, z - 0.03), (0.07, 2.04, 0.06), frame, skip="+z -y"),
    ]
    handle = sheets.box((0.71, 1.0, z - 0.06), (0.12, 0.02, 0.05), texture.plain(rng, (90, 88, 84)))
    panels = [
        sheet
        for y0 in (0.55, 1.45)
        for sheet in sheets.box(
            (1.0, y0, z - 0.042),
            (0.56, 0.7, 0.014),
            texture.wood(rng, (186, 172, 150), contrast=3),
            skip="+z",
        )
    ]
    return [*walls, *board, *leaf, *around, *handle, *panels]


def _window(rng: np.random.Generator) -> list[Sheet]:
    x = WIDTH_M / 2
    pane = sheets.flat((x - 0.02, 2.1, -0.75), (0, 0, 1.5), (0, -1.2, 0), texture.view(rng), glow=1.0)
    sill = sheets.box((x - 0.09, 0.88, 0), (0.18, 0.04, 1.62), texture.plain(rng, (228, 226, 222)), skip="+x")
    cloth = texture.fabric(rng, (122, 74, 62), grain=5, stripes_m=0.11, stripe=9)
    drapes = [
        sheets.curtain((x - 0.1, 2.28, -1.18), (0, 0, 0.5), 2.2, cloth, depth=0.035, folds=5),
        sheets.curtain((x - 0.1, 2.28, 0.68), (0, 0, 0.5), 2.2, cloth, depth=0.035, folds=5),
    ]
    radiator = [
        sheet
        for k in range(12)
        for sheet in sheets.box(
            (x - 0.07, 0.42, -0.55 + 0.1 * k),
            (0.09, 0.6, 0.07),
            texture.plain(rng, (220, 220, 214)),
            skip="+x -y",
        )
    ]
    pot = sheets.cylinder(
        (x - 0.1, 0.97, 0.45),
        0.06,
        0.13,
        texture.plain(rng, (176, 92, 60)),
        texture.plain(rng, (60, 46, 36)),
        flare=1.25,
    )
    return [pane, *sill, *drapes, *radiator, *pot]


def _prints(rng: np.random.Generator) -> list[Sheet]:
    x, z = WIDTH_M / 2 - 0.012, DEPTH_M / 2 - 0.012
    rug = sheets.flat((-0.4, 0.008, -0.5), (1.9, 0, 0), (0, 0, 1.35), texture.rug(rng))
    return [
        rug,
        sheets.flat((-1.6, 1.95, -z), (0.6, 0, 0), (0, -0.8, 0), texture.poster(rng)),
        sheets.flat((-0.75, 1.85, -z), (0.4, 0, 0), (0, -0.5, 0), texture.poster(rng)),
        sheets.flat((1.4, 1.9, -z), (0.5, 0, 0), (0, -0.7, 0), texture.poster(rng)),
        sheets.flat((-x, 1.8, -0.45), (0, 0, -0.7), (0, -0.5, 0), texture.poster(rng)),
        sheets.flat((-x, 1.75, 2.05), (0, 0, -0.45), (0, -0.6, 0), texture.poster(rng)),
        sheets.flat((2.6, 1.75, z), (-0.55, 0, 0), (0, -0.42, 0), texture.poster(rng)),
        sheets.flat((x, 1.8, 1.45), (0, 0, 0.4), (0, -0.5, 0), texture.poster(rng)),
    ]
