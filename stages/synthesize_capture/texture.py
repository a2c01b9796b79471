"""Paints: procedural pictures for the sheets of a home.

Every maker takes a generator and colours and returns a `Paint`, which draws a picture for a sheet of a
given size at `TEXEL_M` (fine prints at `PRINT_TEXEL_M`). Plain surfaces carry only faint structure,
floors and fabrics repeat, and strong features stand where homes have them: posters, books, rugs, labels.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stages.synthesize_capture.sheets import Paint

TEXEL_M = 0.006
PRINT_TEXEL_M = 0.003
Color = tuple[float, float, float]


def plain(
    rng: np.random.Generator,
    color: Color,
    *,
    grain: float = 1.5,
    clouds: float = 2.5,
    texel_m: float = TEXEL_M,
) -> Paint:
    """Paint plaster or lacquer: one colour with faint grain and broad clouds (deviations in grey levels of
    255).
    """

    def paint(width_m: float, height_m: float) -> np.ndarray:
        size = _size(width_m, height_m, texel_m)
        field = (
            grain * _noise(rng, size, 0.0)
            + 0.8 * grain * _noise(rng, size, 0.02 / texel_m)
            + clouds * _noise(rng, size, 0.25 / texel_m)
        )
        return _bytes(np.asarray(color) + field[..., None])

    return paint


def planks(
    rng: np.random.Generator,
    color: Color,
    *,
    plank_m: tuple[float, float] = (0.9, 0.15),
    along_u: bool = True,
) -> Paint:
    """Paint a floor of planks: the same printed board again and again, with hardly visible differences."""
    length, breadth = (max(4, round(part / TEXEL_M)) for part in plank_m)
    streak = cv2.GaussianBlur(
        rng.standard_normal((breadth, length)).astype(np.float32), (0, 0), sigmaX=14, sigmaY=0.7
    )
    knots = cv2.GaussianBlur(
        rng.standard_normal((breadth, length)).astype(np.float32), (0, 0), sigmaX=6, sigmaY=3
    )
    board = 6 * streak / streak.std() + 4 * knots / knots.std()
    board[:1] -= 34
    board[:, :1] -= 30

    def paint(width_m: float, height_m: float) -> np.ndarray:
        size = _size(width_m, height_m, TEXEL_M)
        rows, columns = size if along_u else size[::-1]
        count = rows // breadth + 2
        grey = np.concatenate(
            [
                np.roll(np.tile(board, (1, columns // length + 2)), (row % 3) * length // 3, axis=1)[
                    :, :columns
                ]
                for row in range(count)
            ]
        )
        grey = grey[:rows] + 2.0 * _noise(rng, (rows, columns), 40)
        return _bytes(
            np.asarray(color) + (grey if along_u else grey.T)[..., None] * np.array([1.0, 0.92, 0.8])
        )

    return paint


def wood(rng: np.random.Generator, color: Color, *, contrast: float = 6.0) -> Paint:
    """Paint furniture wood: soft streaks along the longer side."""

    def paint(width_m: float, height_m: float) -> np.ndarray:
        size = _size(width_m, height_m, TEXEL_M)
        along, across = (22.0, 0.8) if width_m >= height_m else (0.8, 22.0)
        streak = cv2.GaussianBlur(
            rng.standard_normal(size).astype(np.float32), (0, 0), sigmaX=along, sigmaY=across
        )
        field = contrast * streak / max(float(streak.std()), 1e-6) + 0.3 * contrast * _noise(rng, size, 12)
        return _bytes(np.asarray(color) + field[..., None] * np.array([1.0, 0.9, 0.75]))

    return paint


def fabric(
    rng: np.random.Generator,
    color: Color,
    *,
    grain: float = 7.0,
    stripes_m: float = 0.0,
    stripe: float = 18.0,
) -> Paint:
    """Paint cloth: a woven grain, soft wear and, if ``stripes_m`` > 0, regular vertical stripes."""

    def paint(width_m: float, height_m: float) -> np.ndarray:
        size = _size(width_m, height_m, TEXEL_M)
        field = (
            grain * 0.6 * _noise(rng, size, 0.0)
            + 0.5 * grain * _noise(rng, size, 3.0)
            + 0.6 * grain * _noise(rng, size, 20.0)
        )
        if stripes_m:
            field = (
                field
                + stripe * np.sign(np.sin(2 * np.pi * np.arange(size[1]) * TEXEL_M / stripes_m))[None, :]
            )
        return _bytes(np.asarray(color) + field[..., None])

    return paint


def rope(rng: np.random.Generator, color: Color) -> Paint:
    """Paint sisal wound around a post: fine level rings."""

    def paint(width_m: float, height_m: float) -> np.ndarray:
        size = _size(width_m, height_m, PRINT_TEXEL_M)
        rings = 22 * np.sin(2 * np.pi * np.arange(size[0]) * PRINT_TEXEL_M / 0.014)[:, None]
        return _bytes(np.asarray(color) + (rings + 10 * _noise(rng, size, 1.5))[..., None])

    return paint


def poster(rng: np.random.Generator) -> Paint:
    """Paint a print: a ground, a few large shapes, small shapes and lines of lettering in a white margin."""

    def paint(width_m: float, height_m: float) -> np.ndarray:
        rows, columns = _size(width_m, height_m, PRINT_TEXEL_M)
        palette = _palette(rng, 5)
        picture = np.empty((rows, columns, 3), np.uint8)
        picture[:] = palette[0]
        _shapes(rng, picture, palette[1:4], count=7, reach=0.35)
        _shapes(rng, picture, palette, count=26, reach=0.07)
        _lettering(rng, picture, palette[4], top=int(0.78 * rows))
        margin = max(3, rows // 30)
        picture[:margin] = picture[-margin:] = 236
        picture[:, :margin] = picture[:, -margin:] = 236
        return picture

    return paint


def books(rng: np.random.Generator) -> Paint:
    """Paint a row of book spines with titles, shadows between them and gaps above."""

    def paint(width_m: float, height_m: float) -> np.ndarray:
        rows, columns = _size(width_m, height_m, PRINT_TEXEL_M)
        picture = np.full((rows, columns, 3), 26, np.uint8)
        left = 0
        while left < columns:
            breadth = int(rng.integers(5, 17))
            top = int(rows * rng.uniform(0.0, 0.3))
            if rng.random() > 0.06:
                color, ink = _palette(rng, 2)
                picture[top:, left + 1 : left + breadth] = color
                for band in rng.uniform(0.1, 0.9, 2):
                    at = top + int(band * (rows - top))
                    picture[at : at + 2, left + 1 : left + breadth] = ink
                for row in range(top + (rows - top) // 4, rows - (rows - top) // 4, 3):
                    if rng.random() < 0.7 and breadth > 7:
                        picture[row : row + 2, left + breadth // 2 - 1 : left + breadth // 2 + 2] = ink
            left += breadth
        return picture

    return paint


def rug(rng: np.random.Generator) -> Paint:
    """Paint a woven rug: borders around a repeated medallion, with a worn pile."""

    def paint(width_m: float, height_m: float) -> np.ndarray:
        rows, columns = _size(width_m, height_m, PRINT_TEXEL_M)
        palette = _palette(rng, 4)
        picture = np.empty((rows, columns, 3), np.uint8)
        picture[:] = palette[0]
        for inset, color in ((0.03, palette[1]), (0.05, palette[2]), (0.12, palette[1]), (0.14, palette[0])):
            pixels = int(inset / PRINT_TEXEL_M)
            picture[pixels : rows - pixels, pixels : columns - pixels] = color
        step = int(0.24 / PRINT_TEXEL_M)
        for row in range(int(0.26 / PRINT_TEXEL_M), rows - step // 2, step):
            for column in range(int(0.26 / PRINT_TEXEL_M), columns - step // 2, step):
                for radius, color in ((0.42, palette[3]), (0.3, palette[1]), (0.16, palette[2])):
                    reach = int(radius * step)
                    diamond = np.array(
                        [
                            [column, row - reach],
                            [column + reach, row],
                            [column, row + reach],
                            [column - reach, row],
                        ]
                    )
                    cv2.fillConvexPoly(picture, diamond, tuple(int(c) for c in color))
        return _bytes(
            picture
            + 9 * _noise(rng, (rows, columns), 0.8)[..., None]
            + 7 * _noise(rng, (rows, columns), 25)[..., None]
        )

    return paint


def carton(rng: np.random.Generator) -> Paint:
    """Paint cardboard with a strip of tape, a label and some print."""

    def paint(width_m: float, height_m: float) -> np.ndarray:
        rows, columns = _size(width_m, height_m, PRINT_TEXEL_M)
        picture = _bytes(np.array([176.0, 138, 96]) + 3 * _noise(rng, (rows, columns), 1.0)[..., None])
        picture[:, int(0.46 * columns) : int(0.54 * columns)] = (198, 174, 128)
        top, left = int(rng.uniform(0.1, 0.4) * rows), int(rng.uniform(0.05, 0.3) * columns)
        label = picture[top : top + rows // 3, left : left + columns // 3]
        label[:] = 232
        _lettering(rng, label, np.array([30, 30, 34]), top=2)
        return picture

    return paint


def view(rng: np.random.Generator) -> Paint:
    """Paint what stands behind a window: bright sky over blurred trees and houses, and the window's bars."""

    def paint(width_m: float, height_m: float) -> np.ndarray:
        rows, columns = _size(width_m, height_m, TEXEL_M)
        picture = np.empty((rows, columns, 3), np.uint8)
        picture[:] = (226, 238, 250)
        for _ in range(14):
            center = int(rng.uniform(0, columns)), int(rng.uniform(0.62, 1.05) * rows)
            shade = tuple(int(value) for value in rng.integers((90, 130, 80), (140, 180, 130)))
            cv2.circle(picture, center, int(rng.uniform(0.08, 0.2) * rows), shade, -1)
        picture = cv2.GaussianBlur(picture, (0, 0), 4)
        bar = max(3, int(0.05 / TEXEL_M))
        for row in (0, rows // 2 - bar // 2, rows - bar):
            picture[row : row + bar] = 168
        for column in (0, columns // 2 - bar // 2, columns - bar):
            picture[:, column : column + bar] = 168
        return picture

    return paint


def _size(width_m: float, height_m: float, texel_m: float) -> tuple[int, int]:
    return max(4, round(height_m / texel_m)), max(4, round(width_m / texel_m))


def _noise(
    rng: np.random.Generator, size: tuple[int, int], blur_texels: float
) -> Float[np.ndarray, "height width"]:
    """Return smooth noise of unit deviation whose grain is about ``blur_texels``."""
    if blur_texels <= 0:
        return rng.standard_normal(size, dtype=np.float32)
    step = max(1, int(blur_texels))
    coarse = rng.standard_normal((size[0] // step + 3, size[1] // step + 3), dtype=np.float32)
    smooth = cv2.resize(
        cv2.GaussianBlur(coarse, (0, 0), 0.8), None, fx=step, fy=step, interpolation=cv2.INTER_CUBIC
    )
    field = smooth[: size[0], : size[1]]
    return field / max(float(smooth.std()), 1e-6)


def _palette(rng: np.random.Generator, count: int) -> UInt8[np.ndarray, "color 3"]:
    hsv = np.stack(
        [rng.integers(0, 180, count), rng.integers(60, 200, count), rng.integers(50, 235, count)], axis=-1
    ).astype(np.uint8)
    return cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]


def _shapes(
    rng: np.random.Generator, picture: np.ndarray, palette: np.ndarray, *, count: int, reach: float
) -> None:
    rows, columns, _ = picture.shape
    for _ in range(count):
        color = tuple(int(value) for value in palette[rng.integers(len(palette))])
        center = int(rng.uniform(0, columns)), int(rng.uniform(0, rows))
        radius = max(2, int(rows * reach * rng.uniform(0.4, 1.0)))
        if rng.random() < 0.5:
            cv2.circle(picture, center, radius, color, -1)
        else:
            cv2.fillPoly(
                picture,
                [np.asarray(center) + rng.integers(-radius, radius + 1, (4, 2)).astype(np.int32)],
                color,
            )


def _lettering(rng: np.random.Generator, picture: np.ndarray, ink: np.ndarray, *, top: int) -> None:
    rows, columns, _ = picture.shape
    for row in range(top + 2, rows - 5, 8):
        left = int(0.12 * columns)
        while left < 0.85 * columns:
            breadth = int(rng.integers(2, 7))
            if rng.random() < 0.8:
                picture[row : row + int(rng.integers(3, 6)), left : left + breadth] = ink
            left += breadth + int(rng.integers(1, 4))


def _bytes(values: np.ndarray) -> UInt8[np.ndarray, "height width 3"]:
    return np.clip(values, 0, 255).astype(np.uint8)
