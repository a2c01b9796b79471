"""The home: one furnished living room as sheets, footprints, favourite places and lights.

`furnish` builds it from a generator: walls with faint plaster, a repeating plank floor, and strong
features only where homes have them. `Room.arranged` puts the movable things somewhere else for another session.
Frame: the world of the truth, +y up, floor at y = 0, metres; x along the long side, z along the short one.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from stages.synthesize_capture import sheets, texture
from stages.synthesize_capture.sheets import Sheet

WIDTH_M, DEPTH_M, HEIGHT_M = 5.2, 4.2, 2.5


@dataclass(frozen=True)
class Footprint:
    """An upright block that stands in the way: centre (x, z), size (x, z) before the turn, turn about +y, height span."""

    center: tuple[float, float]
    size: tuple[float, float]
    yaw: float = 0.0
    bottom: float = 0.0
    top: float = 1.0


@dataclass(frozen=True)
class Place:
    """A place the animal likes: where it stands, which way it looks, and the spot on the floor from which it jumps up."""

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
        moved = [sheet.moved(sheets.upright(x, z, yaw)) for thing, (x, z, yaw) in zip(self.movables, self.arrangement, strict=True) for sheet in thing.sheets]
        return [*self.fixed, *moved]

    def footprints(self) -> list[Footprint]:
        """Return everything that stands in the way."""
        moved = [
            Footprint((x, z), thing.size, yaw, 0.0, thing.height) for thing, (x, z, yaw) in zip(self.movables, self.arrangement, strict=True)
        ]
        return [*self.standing, *moved]

    def arranged(self, rng: np.random.Generator) -> "Room":
        """Return the room after people moved its loose things: each is shifted and turned, some a good way."""
        arrangement = np.array([thing.home for thing in self.movables], float)
        far = rng.random(len(arrangement)) < 0.6
        reach = np.where(far, 0.45, 0.08)[:, None]
        arrangement[:, :2] += reach * rng.uniform(-1, 1, (len(arrangement), 2))
        arrangement[:, 2] += np.where(far, 1.2, 0.1) * rng.uniform(-1, 1, len(arrangement))
        arrangement[:, 0] = np.clip(arrangement[:, 0], -WIDTH_M / 2 + 0.3, WIDTH_M / 2 - 0.3)
        arrangement[:, 1] = np.clip(arrangement[:, 1], -DEPTH_M / 2 + 0.3, DEPTH_M / 2 - 0.3)
        return replace(self, arrangement=arrangement)


def furnish(rng: np.random.Generator) -> Room:
    """Build the room with its usual arrangement; colours, prints and small offsets come from the generator."""
    fixed = [*_shell(rng), *_window(rng), *_prints(rng), *_sofa(rng), *_shelf(rng), *_media(rng), *_cat_tree(rng), *_tables(rng), *_plant(rng), *_lamp(rng)]
    movables = _movables(rng)
    standing = (
        Footprint((-0.9, -1.63), (1.9, 0.88), top=0.8),
        Footprint((-2.43, 0.55), (0.34, 1.2), top=1.9),
        Footprint((-0.9, 1.88), (1.5, 0.42), top=0.9),
        Footprint((2.15, -1.65), (0.62, 0.6), top=1.3),
        Footprint((-0.95, -0.52), (0.86, 0.46), bottom=0.36, top=0.42),
        Footprint((2.0, 1.5), (1.0, 0.9), bottom=0.66, top=0.74),
        Footprint((-2.28, -1.75), (0.42, 0.42), top=1.2),
        Footprint((0.62, -1.85), (0.3, 0.3), top=1.6),
    )
    places = (
        Place("sofa", (-0.6, 0.44, -1.5), 0.0, (-0.35, -0.82)),
        Place("sofa corner", (-1.45, 0.44, -1.5), 0.3, (-1.6, -0.82)),
        Place("bowl", (1.1, 0.0, 1.72), 0.0, (1.1, 1.72)),
        Place("window", (2.2, 0.0, 0.1), np.pi / 2, (2.2, 0.1)),
        Place("rug", (0.5, 0.0, 0.2), -np.pi / 2, (0.5, 0.2)),
        Place("cat tree", (2.1, 0.5, -1.55), -0.6, (1.62, -1.12)),
        Place("shelf", (-1.9, 0.0, 0.6), np.pi / 2, (-1.9, 0.6)),
    )
    half = WIDTH_M / 2
    window = np.array([[half - 0.02, 2.1, -0.75], [0, 0, 1.5], [0, -1.2, 0]], float)
    return Room(tuple(fixed), tuple(movables), np.array([thing.home for thing in movables], float), standing, places, window, (0.62, 1.62, -1.85))


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
        sheets.flat((-x, y, z), (2 * x, 0, 0), (0, 0, -2 * z), texture.plain(rng, (226, 224, 218), clouds=1.5)),
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
    leaf = sheets.box((0.75, 1.0, z - 0.02), (0.8, 2.0, 0.03), door, skip="+z -y")
    around = [*sheets.box((0.31, 1.02, z - 0.03), (0.07, 2.04, 0.06), frame, skip="+z -y"), *sheets.box((1.19, 1.02, z - 0.03), (0.07, 2.04, 0.06), frame, skip="+z -y")]
    handle = sheets.box((0.46, 1.0, z - 0.06), (0.12, 0.02, 0.05), texture.plain(rng, (90, 88, 84)))
    panels = [
        sheet for y0 in (0.55, 1.45) for sheet in sheets.box((0.75, y0, z - 0.042), (0.56, 0.7, 0.014), texture.wood(rng, (186, 172, 150), contrast=3), skip="+z")
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
    radiator = [sheet for k in range(12) for sheet in sheets.box((x - 0.07, 0.42, -0.55 + 0.1 * k), (0.09, 0.6, 0.07), texture.plain(rng, (220, 220, 214)), skip="+x -y")]
    pot = sheets.cylinder((x - 0.1, 0.97, 0.45), 0.06, 0.13, texture.plain(rng, (176, 92, 60)), texture.plain(rng, (60, 46, 36)), flare=1.25)
    return [pane, *sill, *drapes, *radiator, *pot]


def _prints(rng: np.random.Generator) -> list[Sheet]:
    x, z = WIDTH_M / 2 - 0.012, DEPTH_M / 2 - 0.012
    rug = sheets.flat((-0.35, 0.008, -0.42), (1.75, 0, 0), (0, 0, 1.25), texture.rug(rng))
    return [
        rug,
        sheets.flat((-1.75, 1.95, -z), (0.6, 0, 0), (0, -0.8, 0), texture.poster(rng)),
        sheets.flat((-0.95, 1.85, -z), (0.4, 0, 0), (0, -0.5, 0), texture.poster(rng)),
        sheets.flat((1.15, 1.9, -z), (0.5, 0, 0), (0, -0.7, 0), texture.poster(rng)),
        sheets.flat((-x, 1.8, -0.45), (0, 0, -0.7), (0, -0.5, 0), texture.poster(rng)),
        sheets.flat((-x, 1.75, 1.85), (0, 0, -0.45), (0, -0.6, 0), texture.poster(rng)),
        sheets.flat((2.3, 1.75, z), (-0.55, 0, 0), (0, -0.42, 0), texture.poster(rng)),
        sheets.flat((x, 1.8, 1.35), (0, 0, 0.4), (0, -0.5, 0), texture.poster(rng)),
    ]


def _sofa(rng: np.random.Generator) -> list[Sheet]:
    cloth = texture.fabric(rng, tuple(np.array([92.0, 104, 116]) + rng.uniform(-12, 12, 3)), grain=7)
    base = [*sheets.box((-0.9, 0.18, -1.63), (1.86, 0.24, 0.84), cloth), *sheets.box((-0.9, 0.55, -1.98), (1.86, 0.5, 0.16), cloth, skip="-y")]
    arms = [*sheets.cushion((-1.76, 0.4, -1.63), (0.16, 0.5, 0.84), cloth, bulge=0.015), *sheets.cushion((-0.04, 0.4, -1.63), (0.16, 0.5, 0.84), cloth, bulge=0.015)]
    seats = [*sheets.cushion((-1.29, 0.36, -1.55), (0.77, 0.14, 0.68), cloth, bulge=0.022), *sheets.cushion((-0.51, 0.36, -1.55), (0.77, 0.14, 0.68), cloth, bulge=0.022)]
    back = [*sheets.cushion((-1.29, 0.62, -1.85), (0.76, 0.38, 0.14), cloth, bulge=0.03), *sheets.cushion((-0.51, 0.62, -1.85), (0.76, 0.38, 0.14), cloth, bulge=0.03)]
    pillow = [
        sheet.moved(sheets.upright(-1.52, -1.72, 0.3, 0.6))
        for sheet in sheets.cushion((0, 0, 0), (0.38, 0.36, 0.08), texture.fabric(rng, (196, 150, 70), grain=6, stripes_m=0.07), bulge=0.05, skip="")
    ]
    return [*base, *arms, *seats, *back, *pillow]


def _shelf(rng: np.random.Generator) -> list[Sheet]:
    timber = texture.wood(rng, (168, 128, 84))
    x, z, wide, deep = -2.43, 0.55, 1.16, 0.32
    parts = [sheet for side in (-1, 1) for sheet in sheets.box((x, 0.95, z + side * wide / 2), (deep, 1.9, 0.025), timber, skip="-y")]
    parts += sheets.box((x - deep / 2 + 0.01, 0.95, z), (0.012, 1.88, wide), timber, skip="-x -y +y +z -z")
    for level in range(6):
        parts += sheets.box((x, 0.06 + 0.365 * level, z), (deep, 0.025, wide), timber, skip="-x +z -z")
    for level in range(5):
        bottom = 0.0725 + 0.365 * level
        left, right = sorted(rng.uniform(-0.5, 0.5, 2)) if level in (1, 3) else (-0.52, 0.53)
        right = max(right, left + 0.3)
        length, middle = min(right, 0.55) - left, (min(right, 0.55) + left) / 2
        tall = rng.uniform(0.22, 0.28)
        parts += sheets.box((x - 0.02, bottom + tall / 2, z + middle), (0.22, tall, length), {"+x": texture.books(rng), "": texture.plain(rng, (190, 180, 160))}, skip="-y -x")
    parts += sheets.cylinder((x, 0.0725 + 0.365 + 0.08, z - 0.5), 0.05, 0.16, texture.plain(rng, (70, 110, 140)), texture.plain(rng, (40, 60, 80)), flare=0.7)
    parts += [sheets.ball((x + 0.02, 0.0725 + 0.365 * 3 + 0.06, z + 0.5), 0.06, texture.fabric(rng, (190, 70, 60), grain=10))]
    return parts


def _media(rng: np.random.Generator) -> list[Sheet]:
    timber = texture.wood(rng, (120, 92, 68))
    stand = sheets.box((-0.9, 0.24, 1.88), (1.46, 0.44, 0.4), timber, skip="+z -y")
    doors = [sheet for k in range(3) for sheet in sheets.box((-1.38 + 0.48 * k, 0.24, 1.672), (0.45, 0.38, 0.016), texture.wood(rng, (140, 108, 80)), skip="+z")]
    black = texture.plain(rng, (24, 25, 28), grain=1, clouds=1)
    screen = [*sheets.box((-0.9, 0.82, 1.96), (1.1, 0.64, 0.05), black, skip="+z"), *sheets.box((-0.9, 0.475, 1.93), (0.4, 0.03, 0.2), black, skip="+z -y")]
    clutter = [
        *sheets.box((-1.5, 0.5, 1.84), (0.12, 0.08, 0.18), texture.carton(rng), skip="-y"),
        *sheets.cylinder((-0.25, 0.53, 1.85), 0.045, 0.14, texture.poster(rng), texture.plain(rng, (200, 196, 190))),
    ]
    return [*stand, *doors, *screen, *clutter]


def _cat_tree(rng: np.random.Generator) -> list[Sheet]:
    plush, sisal = texture.fabric(rng, (170, 150, 122), grain=8), texture.rope(rng, (186, 158, 112))
    parts = sheets.box((2.15, 0.03, -1.65), (0.6, 0.06, 0.56), plush, skip="-y")
    parts += sheets.cylinder((2.3, 0.26, -1.8), 0.045, 0.42, sisal, plush)
    parts += sheets.cylinder((2.0, 0.26, -1.5), 0.045, 0.42, sisal, plush)
    parts += sheets.box((2.13, 0.48, -1.62), (0.58, 0.04, 0.52), plush)
    parts += sheets.cylinder((2.36, 0.82, -1.88), 0.045, 0.66, sisal, plush)
    parts += sheets.box((2.34, 1.17, -1.86), (0.4, 0.04, 0.38), plush)
    parts += [sheets.ball((2.05, 0.9, -1.75), 0.035, texture.fabric(rng, (210, 60, 90), grain=10))]
    return parts


def _tables(rng: np.random.Generator) -> list[Sheet]:
    oak, birch = texture.wood(rng, (150, 106, 66)), texture.wood(rng, (198, 170, 126))
    parts = sheets.box((-0.95, 0.4, -0.52), (0.86, 0.035, 0.46), oak)
    parts += sheets.box((2.0, 0.72, 1.5), (1.0, 0.03, 0.9), birch)
    for sx in (-1, 1):
        for sz in (-1, 1):
            parts += sheets.box((-0.95 + sx * 0.38, 0.19, -0.52 + sz * 0.18), (0.04, 0.38, 0.04), oak, skip="+y -y")
            parts += sheets.box((2.0 + sx * 0.45, 0.35, 1.5 + sz * 0.4), (0.05, 0.7, 0.05), birch, skip="+y -y")
    parts += sheets.box((-1.1, 0.425, -0.5), (0.24, 0.015, 0.17), {"+y": texture.poster(rng), "": texture.plain(rng, (230, 230, 226))}, skip="-y")
    parts += sheets.box((-1.08, 0.445, -0.52), (0.2, 0.022, 0.14), {"+y": texture.poster(rng), "": texture.books(rng)}, skip="-y")
    parts += sheets.cylinder((-0.72, 0.46, -0.44), 0.038, 0.09, texture.plain(rng, (60, 96, 120)), texture.plain(rng, (70, 44, 26)))
    parts += sheets.cylinder((2.05, 0.77, 1.45), 0.13, 0.07, texture.plain(rng, (214, 208, 196)), texture.fabric(rng, (190, 120, 50), grain=22), flare=1.3)
    parts += sheets.cylinder((1.02, 0.025, 1.86), 0.075, 0.05, texture.plain(rng, (60, 120, 170)), texture.fabric(rng, (110, 76, 46), grain=14), flare=0.8)
    parts += sheets.cylinder((1.24, 0.025, 1.88), 0.075, 0.05, texture.plain(rng, (60, 120, 170)), texture.plain(rng, (170, 190, 200)), flare=0.8)
    return parts


def _plant(rng: np.random.Generator) -> list[Sheet]:
    x, z = -2.28, -1.75
    parts = sheets.cylinder((x, 0.17, z), 0.14, 0.34, texture.plain(rng, (208, 202, 190), clouds=6), texture.fabric(rng, (64, 48, 36), grain=10), flare=1.25)
    for _ in range(26):
        yaw, reach, rise = rng.uniform(0, 2 * np.pi), rng.uniform(0.12, 0.3), rng.uniform(0.35, 0.95)
        t = np.linspace(0, 1, 5)
        out = np.array([np.sin(yaw), 0, np.cos(yaw)])
        spine = np.array([x, 0.34, z]) + t[:, None] * reach * out + (rise * (1.7 * t - 0.75 * t**2))[:, None] * [0, 1, 0]
        half = (0.045 * np.sin(np.pi * np.clip(t * 0.9 + 0.08, 0, 1)))[:, None] * np.array([np.cos(yaw), 0, -np.sin(yaw)])
        points = np.stack([spine - half, spine + half], axis=1)[::-1]
        points[..., 0] = np.maximum(points[..., 0], -WIDTH_M / 2 + 0.01)
        points[..., 2] = np.maximum(points[..., 2], -DEPTH_M / 2 + 0.01)
        green = np.array([62.0, 110, 52]) + rng.uniform(-18, 26, 3)
        parts.append(Sheet(points.astype(np.float32), texture.plain(rng, tuple(green), grain=5, clouds=10)(0.09, rise)))
    return parts


def _lamp(rng: np.random.Generator) -> list[Sheet]:
    x, z = 0.62, -1.85
    metal = texture.plain(rng, (70, 66, 62))
    parts = sheets.cylinder((x, 0.015, z), 0.13, 0.03, metal, metal)
    parts += sheets.cylinder((x, 0.75, z), 0.012, 1.45, metal, metal, segments=6)
    shade = sheets.cylinder((x, 1.58, z), 0.17, 0.26, texture.fabric(rng, (232, 214, 176), grain=4), texture.plain(rng, (250, 240, 214)), flare=0.7)
    return [*parts, *(replace(sheet, glow=0.55) for sheet in shade)]


def _movables(rng: np.random.Generator) -> list[Movable]:
    timber = texture.wood(rng, (176, 138, 92))
    seat = sheets.box((0, 0.44, 0), (0.4, 0.04, 0.4), timber)
    seat += sheets.box((0, 0.7, -0.19), (0.4, 0.34, 0.025), timber)
    for sx in (-1, 1):
        for sz in (-1, 1):
            seat += sheets.box((sx * 0.18, 0.21, sz * 0.18), (0.035, 0.42, 0.035), timber, skip="+y -y")
        seat += sheets.box((sx * 0.18, 0.49, -0.19), (0.035, 0.1, 0.03), timber, skip="+y -y")
    crate = sheets.box((0, 0.13, 0), (0.36, 0.26, 0.28), texture.carton(rng), skip="-y")
    parcel = sheets.box((0, 0.09, 0), (0.26, 0.18, 0.2), texture.carton(rng), skip="-y")
    toy = [sheets.ball((0, 0.045, 0), 0.045, texture.fabric(rng, (220, 90, 50), grain=16, stripes_m=0.07, stripe=40))]
    stool = sheets.cylinder((0, 0.2, 0), 0.2, 0.4, texture.fabric(rng, (140, 70, 80), grain=7, stripes_m=0.1), texture.fabric(rng, (150, 80, 90), grain=8))
    return [
        Movable(tuple(seat), (0.42, 0.42), 0.86, (1.25, 1.25, 0.9)),
        Movable(tuple(crate), (0.36, 0.28), 0.26, (1.9, 0.62, 0.3)),
        Movable(tuple(parcel), (0.26, 0.2), 0.18, (-2.1, 1.6, -0.4)),
        Movable(tuple(toy), (0.09, 0.09), 0.09, (0.9, -0.9, 0.0)),
        Movable(tuple(toy), (0.09, 0.09), 0.09, (-0.3, 0.9, 0.7)),
        Movable(tuple(stool), (0.4, 0.4), 0.4, (0.25, -1.6, 0.0)),
    ]
