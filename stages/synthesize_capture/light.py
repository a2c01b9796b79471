"""Light the room once per recording: daylight through the window, a lamp, soft light between surfaces.

`Light` is one session's light; `lit_sheets` multiplies each sheet's picture by a smooth light map that is
found by casting rays at a coarse grid of points (Lambertian surfaces, one bounce approximated by a constant).
Radiance is relative: 1.0 is a white wall in good light.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.geometry.meshes import Mesh, RayCaster
from stages.synthesize_capture.room import Room
from stages.synthesize_capture.sheets import Sheet, triangles

LIGHT_CELL_M = 0.09
AMBIENT_REACH_M = 1.1
Rgb = Float[np.ndarray, "3"]
Hour = Literal["day", "evening"]


@dataclass(frozen=True)
class Light:
    """One session's light; colors are linear RGB."""

    window: Rgb
    lamp: Rgb
    ambient: Rgb
    toward_sun: Float[np.ndarray, "3"]
    """World direction in which the window is brightest."""


def light_of_session(rng: np.random.Generator, hour: Hour) -> Light:
    """Draw a light: by day the window rules, in the evening the lamp."""
    warm, cool = np.array([1.0, 0.82, 0.6]), np.array([0.9, 0.98, 1.08])
    if hour == "evening":
        window, lamp, ambient = 0.10 * cool, rng.uniform(0.75, 0.95) * warm, 0.16 * np.array([1.0, 0.9, 0.78])
    else:
        window = rng.uniform(1.3, 2.2) * (cool + rng.uniform(-0.06, 0.06, 3))
        lamp = rng.uniform(0.0, 0.25) * warm
        ambient = rng.uniform(0.42, 0.55) * (1.0 + rng.uniform(-0.05, 0.05, 3))
    sun = np.array([1.0, rng.uniform(0.3, 0.7), rng.uniform(-0.8, 0.8)])
    return Light(window, lamp, ambient, sun / np.linalg.norm(sun))


def lit_sheets(
    room: Room, light: Light, rng: np.random.Generator
) -> list[UInt8[np.ndarray, "height width 3"]]:
    """Return each sheet's picture in that light, as square roots of linear radiance (255 = 2.0)."""
    sheets = room.sheets()
    vertices, faces, _, _ = triangles(sheets)
    caster = RayCaster(Mesh(vertices, faces))
    grids = [_light_grid(sheet) for sheet in sheets]
    points = np.concatenate([grid[0].reshape(-1, 3) for grid in grids])
    normals = np.concatenate([grid[1].reshape(-1, 3) for grid in grids])
    radiance = _irradiance(points, normals, room, light, caster, rng)
    lit, start = [], 0
    for sheet, (grid, _) in zip(sheets, grids, strict=True):
        rows, columns, _ = grid.shape
        cells = radiance[start : start + rows * columns].reshape(rows, columns, 3).astype(np.float32)
        start += rows * columns
        lit.append(_lit_picture(sheet, cells, light))
    return lit


def _lit_picture(
    sheet: Sheet, cells: Float[np.ndarray, "row column 3"], light: Light
) -> UInt8[np.ndarray, "height width 3"]:
    height, width, _ = sheet.picture.shape
    albedo = (np.arange(256, dtype=np.float32) / 255) ** 2.2
    if sheet.glow > 0:
        shine = light.window if sheet.glow == 1.0 else 0.25 * light.ambient + 1.1 * light.lamp
        field = np.broadcast_to(sheet.glow * np.asarray(shine, np.float32), (height, width, 3))
    else:
        smooth = cv2.GaussianBlur(cells, (3, 3), 0.7) if min(cells.shape[:2]) > 2 else cells
        field = cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR)
    linear = albedo[sheet.picture] * field
    return np.clip(np.sqrt(linear / 2.0) * 255 + 0.5, 0, 255).astype(np.uint8)


def _light_grid(sheet: Sheet) -> tuple[np.ndarray, np.ndarray]:
    """Return points slightly in front of the sheet and their normals, on a grid of about `LIGHT_CELL_M`."""
    down, right = sheet.size_m()
    rows, columns = (int(np.clip(np.ceil(size / LIGHT_CELL_M), 2, 80)) for size in (down, right))
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    at = (v * (sheet.points.shape[0] - 1), u * (sheet.points.shape[1] - 1))
    points, normals = _bilinear(sheet.points, *at), _bilinear(sheet.normals(), *at)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    return points + 0.008 * normals, normals


def _bilinear(grid: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    i, j = np.clip(row.astype(int), 0, grid.shape[0] - 2), np.clip(column.astype(int), 0, grid.shape[1] - 2)
    s, t = (row - i)[..., None], (column - j)[..., None]
    return (1 - s) * ((1 - t) * grid[i, j] + t * grid[i, j + 1]) + s * (
        (1 - t) * grid[i + 1, j] + t * grid[i + 1, j + 1]
    )


def _irradiance(
    points: np.ndarray,
    normals: np.ndarray,
    room: Room,
    light: Light,
    caster: RayCaster,
    rng: np.random.Generator,
) -> Float[np.ndarray, "point 3"]:
    total = np.zeros((len(points), 3))
    openness = np.zeros(len(points))
    sine = np.sqrt((np.arange(12) + rng.random(12)) / 12)  # of stratified, cosine-weighted polar angles
    spread = np.stack([sine, np.sqrt(1 - sine**2)], axis=-1)
    for direction in spread:
        turn = rng.uniform(0, 2 * np.pi, len(points))
        rays = _around(normals, direction, turn)
        openness += np.minimum(caster.cast(points, rays).distance / AMBIENT_REACH_M, 1.0)
    total += (openness / len(spread))[:, None] ** 1.2 * light.ambient * (0.85 + 0.15 * normals[:, 1:2])
    corner, right, down = room.window
    for i in range(2):
        for j in range(3):
            jitter = rng.uniform(-0.12, 0.12, 2)
            sample = corner + (j + 0.5 + jitter[0]) / 3 * right + (i + 0.5 + jitter[1]) / 2 * down
            sample -= np.array([0.06, 0, 0])
            area = np.linalg.norm(right) * np.linalg.norm(down) / 6
            factor = _from_source(points, normals, sample, caster, toward_sun=light.toward_sun)
            total += factor[:, None] * light.window * area
    for shift in ((0.0, 0.22, 0.0), (0.0, -0.2, 0.0)):
        factor = _from_source(points, normals, np.asarray(room.lamp) + shift, caster)
        total += factor[:, None] * light.lamp * 0.6
    return total


def _from_source(
    points, normals, source, caster: RayCaster, *, toward_sun=None
) -> Float[np.ndarray, "point"]:
    """Return form factors of a small source; a window faces -x and shines strongest from the sun's side."""
    away = source - points
    distance = np.linalg.norm(away, axis=-1)
    ray = away / distance[:, None]
    factor = np.maximum((normals * ray).sum(-1), 0) / np.maximum(distance, 0.25) ** 2
    if toward_sun is not None:
        from_sun = 0.5 + 1.5 * np.maximum(ray @ toward_sun, 0) ** 3
        factor *= np.maximum(-(ray @ np.array([-1.0, 0, 0])), 0) / np.pi * from_sun
    clear = factor > 1e-4
    blocked = caster.cast(points[clear], ray[clear]).distance < distance[clear] - 0.05
    factor[clear] *= ~blocked
    return factor


def _around(normals: np.ndarray, sine_cosine: np.ndarray, turn: np.ndarray) -> np.ndarray:
    helper = np.where(np.abs(normals[:, :1]) > 0.8, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(normals, first)
    across = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
    return sine_cosine[0] * across + sine_cosine[1] * normals


def light_on_body(
    points: Float[np.ndarray, "vertex 3"], normals: Float[np.ndarray, "vertex 3"], room: Room, light: Light
) -> Float[np.ndarray, "vertex 3"]:
    """Return the light that reaches a small body's surface, without cast shadows; undersides get less."""
    up = 0.5 + 0.5 * normals[:, 1:2]
    total = (0.35 + 0.6 * up) * light.ambient
    corner, right, down = room.window
    window = light.window * np.linalg.norm(right) * np.linalg.norm(down) / np.pi
    middle, lamp = corner + 0.5 * right + 0.5 * down, np.asarray(room.lamp)
    for source, strength in ((middle, window), (lamp, light.lamp * 1.2)):
        away = source - points.mean(0)
        distance = max(float(np.linalg.norm(away)), 0.4)
        ray = away / distance
        fall = 1.0 / distance**2
        if source is middle:
            fall *= max(float(ray[0]), 0.0) * (0.5 + 1.5 * max(float(ray @ light.toward_sun), 0.0) ** 3)
        total = total + np.clip((normals @ ray + 0.25) / 1.25, 0, 1)[:, None] * fall * strength
    return total.astype(np.float32)
