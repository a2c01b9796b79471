"""Paints: procedural pictures for the sheets of a home.

Every maker takes a generator and colors and returns a `Paint`, which draws a picture for a sheet of a
given size at `TEXEL_M` (fine prints at `PRINT_TEXEL_M`). Plain surfaces carry only faint structure,
floors and fabrics repeat, and strong features stand where homes have them: posters, books, rugs, labels.
"""

from collections.abc import Callable
from functools import wraps
from typing import Concatenate, ParamSpec

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stages.synthesize_capture.sheets import Paint

TEXEL_M = 0.006
PRINT_TEXEL_M = 0.003
Color = tuple[float, float, float]
Size = tuple[int, int]
"""Rows and columns of texels."""
Picture = UInt8[np.ndarray, "height width 3"]
Arguments = ParamSpec("Arguments")


def _maker(texel_m: float):
    """Let a function that draws texels of this size make paints, which draw when they are put on a sheet."""

    def decorate(draw: Callable[Concatenate[Size, Arguments], Picture]) -> Callable[Arguments, Paint]:
        @wraps(draw)
        def make(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Paint:
            def paint(width_m: float, height_m: float) -> Picture:
                size = max(4, round(height_m / texel_m)), max(4, round(width_m / texel_m))
                return draw(size, *args, **kwargs)

            return paint

        return make

    return decorate


@_maker(TEXEL_M)
def plain(
    size: Size, rng: np.random.Generator, color: Color, *, grain: float = 1.5, clouds: float = 2.5
) -> Picture:
    """Paint plaster or lacquer: one color with faint grain and broad clouds, deviations of 255 levels."""
    field = (
        grain * _noise(rng, size, 0.0)
        + 0.8 * grain * _noise(rng, size, 0.02 / TEXEL_M)
        + clouds * _noise(rng, size, 0.25 / TEXEL_M)
    )
    return _bytes(np.asarray(color) + field[..., None])


@_maker(TEXEL_M)
def planks(size: Size, rng: np.random.Generator, color: Color) -> Picture:
    """Paint a floor of planks: the same printed board again and again, with hardly visible differences."""
    (rows, columns), length, breadth = size, round(0.9 / TEXEL_M), round(0.15 / TEXEL_M)
    streak, knots = (
        cv2.GaussianBlur(
            rng.standard_normal((breadth, length)).astype(np.float32), (0, 0), sigmaX=x, sigmaY=y
        )
        for x, y in ((14, 0.7), (6, 3))
    )
    board = 6 * streak / streak.std() + 4 * knots / knots.std()
    board[:1] -= 34
    board[:, :1] -= 30
    line = np.tile(board, (1, columns // length + 2))
    shifts = [(row % 3) * length // 3 for row in range(rows // breadth + 2)]
    gray = np.concatenate([np.roll(line, shift, axis=1)[:, :columns] for shift in shifts])[:rows]
    gray = gray + 2.0 * _noise(rng, size, 40)
    return _bytes(np.asarray(color) + gray[..., None] * np.array([1.0, 0.92, 0.8]))


@_maker(TEXEL_M)
def wood(size: Size, rng: np.random.Generator, color: Color, *, contrast: float = 6.0) -> Picture:
    """Paint furniture wood: soft streaks along the longer side."""
    along, across = (22.0, 0.8) if size[1] >= size[0] else (0.8, 22.0)
    streak = cv2.GaussianBlur(
        rng.standard_normal(size).astype(np.float32), (0, 0), sigmaX=along, sigmaY=across
    )
    field = contrast * streak / max(float(streak.std()), 1e-6) + 0.3 * contrast * _noise(rng, size, 12)
    return _bytes(np.asarray(color) + field[..., None] * np.array([1.0, 0.9, 0.75]))


@_maker(TEXEL_M)
def fabric(
    size: Size,
    rng: np.random.Generator,
    color: Color,
    *,
    grain: float = 7.0,
    stripes_m: float = 0.0,
    stripe: float = 18.0,
) -> Picture:
    """Paint cloth: a woven grain, soft wear and, if ``stripes_m`` > 0, regular vertical stripes."""
    field = (
        grain * 0.6 * _noise(rng, size, 0.0)
        + 0.5 * grain * _noise(rng, size, 3.0)
        + 0.6 * grain * _noise(rng, size, 20.0)
    )
    if stripes_m:
        field = field + stripe * np.sign(np.sin(2 * np.pi * np.arange(size[1]) * TEXEL_M / stripes_m))
    return _bytes(np.asarray(color) + field[..., None])


@_maker(PRINT_TEXEL_M)
def rope(size: Size, rng: np.random.Generator, color: Color) -> Picture:
    """Paint sisal wound around a post: fine level rings."""
    rings = 22 * np.sin(2 * np.pi * np.arange(size[0]) * PRINT_TEXEL_M / 0.014)[:, None]
    return _bytes(np.asarray(color) + (rings + 10 * _noise(rng, size, 1.5))[..., None])


@_maker(PRINT_TEXEL_M)
def poster(size: Size, rng: np.random.Generator) -> Picture:
    """Paint a print: a ground, a few large shapes, small shapes and lines of lettering in a white margin."""
    rows, columns = size
    palette = _palette(rng, 5)
    picture = np.full((rows, columns, 3), palette[0])
    _shapes(rng, picture, palette[1:4], count=7, reach=0.35)
    _shapes(rng, picture, palette, count=26, reach=0.07)
    _lettering(rng, picture, palette[4], top=int(0.78 * rows))
    margin = max(3, rows // 30)
    picture[:margin] = picture[-margin:] = 236
    picture[:, :margin] = picture[:, -margin:] = 236
    return picture


@_maker(PRINT_TEXEL_M)
def books(size: Size, rng: np.random.Generator) -> Picture:
    """Paint a row of book spines with titles, shadows between them and gaps above."""
    rows, columns = size
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


@_maker(PRINT_TEXEL_M)
def rug(size: Size, rng: np.random.Generator) -> Picture:
    """Paint a woven rug: borders around a repeated medallion, with a worn pile."""
    rows, columns = size
    palette = _palette(rng, 4)
    picture = np.full((rows, columns, 3), palette[0])
    for inset, color in ((0.03, palette[1]), (0.05, palette[2]), (0.12, palette[1]), (0.14, palette[0])):
        pixels = int(inset / PRINT_TEXEL_M)
        picture[pixels : rows - pixels, pixels : columns - pixels] = color
    step = int(0.24 / PRINT_TEXEL_M)
    for row in range(int(0.26 / PRINT_TEXEL_M), rows - step // 2, step):
        for column in range(int(0.26 / PRINT_TEXEL_M), columns - step // 2, step):
            for radius, color in ((0.42, palette[3]), (0.3, palette[1]), (0.16, palette[2])):
                reach = int(radius * step)
                center, diamond = np.array([column, row]), np.array([[0, -1], [1, 0], [0, 1], [-1, 0]])
                cv2.fillConvexPoly(picture, center + reach * diamond, color.tolist())
    return _bytes(picture + 9 * _noise(rng, size, 0.8)[..., None] + 7 * _noise(rng, size, 25)[..., None])


@_maker(PRINT_TEXEL_M)
def carton(size: Size, rng: np.random.Generator) -> Picture:
    """Paint cardboard with a strip of tape, a label and some print."""
    rows, columns = size
    picture = _bytes(np.array([176.0, 138, 96]) + 3 * _noise(rng, (rows, columns), 1.0)[..., None])
    picture[:, int(0.46 * columns) : int(0.54 * columns)] = (198, 174, 128)
    top, left = int(rng.uniform(0.1, 0.4) * rows), int(rng.uniform(0.05, 0.3) * columns)
    label = picture[top : top + rows // 3, left : left + columns // 3]
    label[:] = 232
    _lettering(rng, label, np.array([30, 30, 34]), top=2)
    return picture


@_maker(TEXEL_M)
def view(size: Size, rng: np.random.Generator) -> Picture:
    """Paint what stands behind a window: bright sky over blurred trees and houses, and the window's bars."""
    rows, columns = size
    picture = np.full((rows, columns, 3), (226, 238, 250), np.uint8)
    for _ in range(14):
        center = int(rng.uniform(0, columns)), int(rng.uniform(0.62, 1.05) * rows)
        shade = rng.integers((90, 130, 80), (140, 180, 130)).tolist()
        cv2.circle(picture, center, int(rng.uniform(0.08, 0.2) * rows), shade, -1)
    picture = cv2.GaussianBlur(picture, (0, 0), 4)
    bar = max(3, int(0.05 / TEXEL_M))
    for row in (0, rows // 2 - bar // 2, rows - bar):
        picture[row : row + bar] = 168
    for column in (0, columns // 2 - bar // 2, columns - bar):
        picture[:, column : column + bar] = 168
    return picture


def _noise(rng: np.random.Generator, size: Size, blur_texels: float) -> Float[np.ndarray, "height width"]:
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
        color = palette[rng.integers(len(palette))].tolist()
        center = int(rng.uniform(0, columns)), int(rng.uniform(0, rows))
        radius = max(2, int(rows * reach * rng.uniform(0.4, 1.0)))
        if rng.random() < 0.5:
            cv2.circle(picture, center, radius, color, -1)
        else:
            corners = rng.integers(-radius, radius + 1, (4, 2)).astype(np.int32)
            cv2.fillPoly(picture, [np.asarray(center) + corners], color)


def _lettering(rng: np.random.Generator, picture: np.ndarray, ink: np.ndarray, *, top: int) -> None:
    rows, columns, _ = picture.shape
    for row in range(top + 2, rows - 5, 8):
        left = int(0.12 * columns)
        while left < 0.85 * columns:
            breadth = int(rng.integers(2, 7))
            if rng.random() < 0.8:
                picture[row : row + int(rng.integers(3, 6)), left : left + breadth] = ink
            left += breadth + int(rng.integers(1, 4))


def _bytes(values: np.ndarray) -> Picture:
    return np.clip(values, 0, 255).astype(np.uint8)
