"""Pieces of furniture and loose things, each about its own origin: floor at y = 0, back to -z, meters."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from stages.synthesize_capture.sheets import Paint, Sheet, ball, box, cushion, cylinder, upright
from stages.synthesize_capture.texture import books, carton, fabric, plain, poster, rope, wood


@dataclass(frozen=True)
class Piece:
    """A piece of furniture: its visible sheets, and the box that it occupies."""

    sheets: list[Sheet]
    size: tuple[float, float]
    """Along x and z."""
    top: float
    bottom: float = 0.0
    """Above 0 if one can walk under it."""


def sofa(rng: np.random.Generator) -> Piece:
    """Make a two-seat sofa with a pillow."""
    cloth = fabric(rng, tuple(np.array([92.0, 104, 116]) + rng.uniform(-12, 12, 3)), grain=7)
    parts = [
        *box((0, 0.18, 0.02), (1.86, 0.24, 0.84), cloth),
        *box((0, 0.55, -0.33), (1.86, 0.5, 0.16), cloth, skip="-y"),
    ]
    for side in (-1, 1):
        parts += cushion((side * 0.86, 0.4, 0.02), (0.16, 0.5, 0.84), cloth, bulge=0.015)
        parts += cushion((side * 0.39, 0.36, 0.1), (0.77, 0.14, 0.68), cloth, bulge=0.022)
        parts += cushion((side * 0.39, 0.62, -0.2), (0.76, 0.38, 0.14), cloth, bulge=0.03)
    striped = fabric(rng, (196, 150, 70), grain=6, stripes_m=0.07)
    pillow = cushion((0, 0, 0), (0.38, 0.36, 0.08), striped, bulge=0.05, skip="")
    parts += [sheet.moved(upright(-0.62, -0.07, 0.3, 0.6)) for sheet in pillow]
    return Piece(parts, (1.9, 0.88), 0.8)


def shelf(rng: np.random.Generator) -> Piece:
    """Make a shelf with five rows of books and a few things between them."""
    timber = wood(rng, (168, 128, 84))
    wide, deep = 1.16, 0.32
    parts = []
    for side in (-1, 1):
        parts += box((side * wide / 2, 0.95, 0), (0.025, 1.9, deep), timber, skip="-y")
    parts += box((0, 0.95, -deep / 2 + 0.01), (wide, 1.88, 0.012), timber, skip="-z -y +y +x -x")
    for level in range(6):
        parts += box((0, 0.06 + 0.365 * level, 0), (wide, 0.025, deep), timber, skip="-z +x -x")
    for level in range(5):
        bottom = 0.0725 + 0.365 * level
        left, right = sorted(rng.uniform(-0.5, 0.5, 2)) if level in (1, 3) else (-0.52, 0.53)
        right = min(max(right, left + 0.3), 0.55)
        tall = rng.uniform(0.22, 0.28)
        spines = {"+z": books(rng), "": plain(rng, (190, 180, 160))}
        center = ((left + right) / 2, bottom + tall / 2, -0.02)
        parts += box(center, (right - left, tall, 0.22), spines, skip="-y -z")
    outside, inside = plain(rng, (70, 110, 140)), plain(rng, (40, 60, 80))
    parts += cylinder((0.5, 0.0725 + 0.365 + 0.08, 0), 0.05, 0.16, outside, inside, flare=0.7)
    parts += [ball((-0.5, 0.0725 + 0.365 * 3 + 0.06, 0.02), 0.06, fabric(rng, (190, 70, 60), grain=10))]
    return Piece(parts, (1.2, 0.34), 1.9)


def media(rng: np.random.Generator) -> Piece:
    """Make a low cupboard with a dark screen on it."""
    timber = wood(rng, (120, 92, 68))
    door, black = wood(rng, (140, 108, 80)), plain(rng, (24, 25, 28), grain=1, clouds=1)
    parts = box((0, 0.24, 0), (1.46, 0.44, 0.4), timber, skip="-z -y")
    for k in range(3):
        parts += box((-0.48 + 0.48 * k, 0.24, 0.208), (0.45, 0.38, 0.016), door, skip="-z")
    parts += box((0, 0.82, -0.08), (1.1, 0.64, 0.05), black, skip="-z")
    parts += box((0, 0.475, -0.05), (0.4, 0.03, 0.2), black, skip="-z -y")
    parts += box((0.6, 0.5, 0.04), (0.12, 0.08, 0.18), carton(rng), skip="-y")
    parts += cylinder((-0.65, 0.53, 0.03), 0.045, 0.14, poster(rng), plain(rng, (200, 196, 190)))
    return Piece(parts, (1.5, 0.42), 0.9)


def cat_tree(rng: np.random.Generator) -> Piece:
    """Make a cat tree: two platforms on sisal posts, and a toy that hangs from the upper one."""
    plush, sisal = fabric(rng, (170, 150, 122), grain=8), rope(rng, (186, 158, 112))
    parts = box((0, 0.03, 0), (0.6, 0.06, 0.56), plush, skip="-y")
    parts += cylinder((0.15, 0.26, -0.15), 0.045, 0.42, sisal, plush)
    parts += cylinder((-0.15, 0.26, 0.15), 0.045, 0.42, sisal, plush)
    parts += box((-0.02, 0.48, 0.03), (0.58, 0.04, 0.52), plush)
    parts += cylinder((0.2, 0.82, -0.2), 0.045, 0.66, sisal, plush)
    parts += box((0.17, 1.17, -0.2), (0.4, 0.04, 0.34), plush)
    parts += [ball((-0.02, 0.94, -0.1), 0.035, fabric(rng, (210, 60, 90), grain=10))]
    parts += cylinder((-0.02, 1.06, -0.1), 0.004, 0.2, plush, plush, segments=4)
    return Piece(parts, (0.62, 0.6), 1.3)


def coffee_table(rng: np.random.Generator) -> Piece:
    """Make a low table with books and a cup; a cat walks under it."""
    oak = wood(rng, (150, 106, 66))
    parts = box((0, 0.4, 0), (0.86, 0.035, 0.46), oak) + _legs(0.38, 0.18, 0.38, 0.04, oak)
    parts += box((-0.15, 0.425, 0.02), (0.24, 0.015, 0.17), _paper(rng), skip="-y")
    parts += box((-0.13, 0.445, 0.0), (0.2, 0.022, 0.14), {"+y": poster(rng), "": books(rng)}, skip="-y")
    parts += cylinder((0.23, 0.46, 0.08), 0.038, 0.09, plain(rng, (60, 96, 120)), plain(rng, (70, 44, 26)))
    return Piece(parts, (0.86, 0.46), 0.42, 0.36)


def dining_table(rng: np.random.Generator) -> Piece:
    """Make a table with a fruit bowl; a cat walks under it."""
    birch = wood(rng, (198, 170, 126))
    parts = box((0, 0.72, 0), (1.0, 0.03, 0.9), birch) + _legs(0.45, 0.4, 0.7, 0.05, birch)
    outside, inside = plain(rng, (214, 208, 196)), plain(rng, (120, 112, 100))
    parts += cylinder((0.05, 0.765, -0.05), 0.11, 0.06, outside, inside, flare=1.3)
    for angle in np.linspace(0, 2 * np.pi, 5, endpoint=False):
        color = ((206, 120, 40), (190, 60, 44), (150, 170, 60))[int(rng.integers(3))]
        center = (0.05 + 0.06 * np.sin(angle), 0.81, -0.05 + 0.06 * np.cos(angle))
        parts.append(ball(center, 0.04, plain(rng, color, grain=5, clouds=10)))
    parts += box((-0.3, 0.738, 0.2), (0.3, 0.006, 0.21), _paper(rng), skip="-y")
    return Piece(parts, (1.0, 0.9), 0.74, 0.66)


def _legs(x: float, z: float, height: float, thick: float, paint: Paint) -> list[Sheet]:
    corners = ((-x, -z), (-x, z), (x, -z), (x, z))
    size = (thick, height, thick)
    return [each for x, z in corners for each in box((x, height / 2, z), size, paint, skip="+y -y")]


def _paper(rng: np.random.Generator) -> dict[str, Paint]:
    """Return paints of a printed sheet."""
    return {"+y": poster(rng), "": plain(rng, (230, 230, 226))}


def plant(rng: np.random.Generator) -> Piece:
    """Make a pot plant with long bent leaves."""
    soil = fabric(rng, (64, 48, 36), grain=10)
    parts = cylinder((0, 0.17, 0), 0.14, 0.34, plain(rng, (208, 202, 190), clouds=6), soil, flare=1.25)
    for _ in range(26):
        yaw, reach, rise = rng.uniform(0, 2 * np.pi), rng.uniform(0.12, 0.3), rng.uniform(0.35, 0.95)
        t = np.linspace(0, 1, 5)
        out, across = np.array([np.sin(yaw), 0, np.cos(yaw)]), np.array([np.cos(yaw), 0, -np.sin(yaw)])
        up = (rise * (1.7 * t - 0.75 * t**2))[:, None] * [0, 1, 0]
        spine = np.array([0, 0.34, 0]) + t[:, None] * reach * out + up
        half = (0.045 * np.sin(np.pi * np.clip(t * 0.9 + 0.08, 0, 1)))[:, None] * across
        points = np.stack([spine - half, spine + half], axis=1)[::-1]
        green = plain(rng, tuple(np.array([62.0, 110, 52]) + rng.uniform(-18, 26, 3)), grain=5, clouds=10)
        parts.append(Sheet(points.astype(np.float32), green(0.09, rise)))
    return Piece(parts, (0.42, 0.42), 1.2)


def lamp(rng: np.random.Generator) -> Piece:
    """Make a standing lamp."""
    metal, cloth = plain(rng, (70, 66, 62)), fabric(rng, (232, 214, 176), grain=4)
    inside = plain(rng, (250, 240, 214))
    parts = cylinder((0, 0.015, 0), 0.13, 0.03, metal, metal)
    parts += cylinder((0, 0.75, 0), 0.012, 1.45, metal, metal, segments=6)
    shade = cylinder((0, 1.58, 0), 0.17, 0.26, cloth, inside, flare=0.7)
    return Piece([*parts, *(replace(sheet, glow=0.55) for sheet in shade)], (0.3, 0.3), 1.6)


def bowls(rng: np.random.Generator) -> Piece:
    """Make a food and a water bowl, too low to be in anyone's way."""
    blue = plain(rng, (60, 120, 170))
    parts = cylinder((-0.11, 0.025, 0), 0.075, 0.05, blue, fabric(rng, (110, 76, 46), grain=14), flare=0.8)
    parts += cylinder((0.11, 0.025, 0.02), 0.075, 0.05, blue, plain(rng, (170, 190, 200)), flare=0.8)
    return Piece(parts, (0.36, 0.15), 0.05)


MAKERS: dict[str, Callable[[np.random.Generator], Piece]] = {
    "sofa": sofa,
    "shelf": shelf,
    "media": media,
    "cat tree": cat_tree,
    "coffee table": coffee_table,
    "dining table": dining_table,
    "plant": plant,
    "lamp": lamp,
    "bowls": bowls,
}


def loose_things(rng: np.random.Generator) -> list[Piece]:
    """Make what people move about: a chair, a crate, a parcel, two balls, a stool."""
    timber = wood(rng, (176, 138, 92))
    chair = box((0, 0.44, 0), (0.4, 0.04, 0.4), timber)
    chair += box((0, 0.7, -0.19), (0.4, 0.34, 0.025), timber)
    for sx in (-1, 1):
        for sz in (-1, 1):
            chair += box((sx * 0.18, 0.21, sz * 0.18), (0.035, 0.42, 0.035), timber, skip="+y -y")
        chair += box((sx * 0.18, 0.49, -0.19), (0.035, 0.1, 0.03), timber, skip="+y -y")
    crate = box((0, 0.13, 0), (0.36, 0.26, 0.28), carton(rng), skip="-y")
    parcel = box((0, 0.09, 0), (0.26, 0.18, 0.2), carton(rng), skip="-y")
    toy = [ball((0, 0.045, 0), 0.045, fabric(rng, (220, 90, 50), grain=16, stripes_m=0.07, stripe=40))]
    cloth = fabric(rng, (140, 70, 80), grain=7, stripes_m=0.1)
    stool = cylinder((0, 0.2, 0), 0.2, 0.4, cloth, fabric(rng, (150, 80, 90), grain=8))
    return [
        Piece(chair, (0.42, 0.42), 0.86),
        Piece(crate, (0.36, 0.28), 0.26),
        Piece(parcel, (0.26, 0.2), 0.18),
        Piece(toy, (0.09, 0.09), 0.09),
        Piece(toy, (0.09, 0.09), 0.09),
        Piece(stool, (0.4, 0.4), 0.4),
    ]
