"""Shading of a rasterized view: lit textures with mip maps, fur, and a soft shadow under the animal.

`Backdrop` holds a recording's lit room as one mesh with an atlas of mip maps; `shade` makes a linear RGB
image from a view at twice the image's size: pixels whose four samples agree are shaded once, edges four
times.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numba import njit

from pipeline.geometry.meshes import Mesh
from stages.synthesize_capture.sheets import Sheet, triangles

RADIANCE_RANGE = 2.0


class Backdrop(NamedTuple):
    """The lit room: mesh, picture coordinates per face corner, and the atlas of mip maps.

    A named tuple, as `Coat`, because compiled functions take those.

    ``levels`` holds start, height and width of each sheet's maps in the flat atlas.
    """

    vertices: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    corners: Float[np.ndarray, "face 3 2"]
    owner: Int[np.ndarray, "face"]
    normals: Float[np.ndarray, "face 3"]
    atlas: UInt8[np.ndarray, "byte"]
    levels: Int[np.ndarray, "sheet level 3"]
    texels_per_m: Float[np.ndarray, "sheet"]


def backdrop(sheets: list[Sheet], lit: list[UInt8[np.ndarray, "height width 3"]]) -> Backdrop:
    """Pack the sheets and their lit pictures."""
    vertices, faces, coordinates, owner = triangles(sheets)
    parts, start = [], 0
    levels = np.zeros((len(sheets), 8, 3), np.int64)
    for index, picture in enumerate(lit):
        for level in range(8):
            height, width = picture.shape[:2]
            levels[index, level] = start, height, width
            parts.append(picture.reshape(-1))
            start += picture.size
            half = (max(1, width // 2), max(1, height // 2))
            picture = cv2.resize(picture, half, interpolation=cv2.INTER_AREA)
    widths = [max(sheet.size_m()[1], 1e-3) for sheet in sheets]
    density = np.array([picture.shape[1] / m for picture, m in zip(lit, widths, strict=True)], np.float32)
    normals, atlas = Mesh(vertices, faces).face_normals().astype(np.float32), np.concatenate(parts)
    return Backdrop(vertices, faces, coordinates[faces], owner, normals, atlas, levels, density)


class Coat(NamedTuple):
    """The animal in one frame: faces, rest points, light per vertex, and balls that shade the ground."""

    faces: Int[np.ndarray, "face 3"]
    rest: Float[np.ndarray, "vertex 3"]
    light: Float[np.ndarray, "vertex 3"]
    """Linear RGB light that reaches each vertex."""
    pattern: Float[np.ndarray, "vertex 4"]
    """Base albedo (linear RGB) and how strongly the fine fur pattern shows."""
    shadow: Float[np.ndarray, "ball 4"]
    """Camera-frame center and radius."""


def shade(
    view_face: Int[np.ndarray, "rows columns"],
    inverse_corners: Float[np.ndarray, "face 3 3"],
    focal_center: tuple[float, float, float, float],
    room: Backdrop,
    coat: Coat,
    camera_from_world: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "height width 3"]:
    """Return linear RGB of a view whose samples are twice as dense; ``focal_center`` = fx fy cx cy of the
    image.

    Faces from ``len(room.faces)`` on are the animal's.
    """
    height, width = view_face.shape[0] // 2, view_face.shape[1] // 2
    out = np.zeros((height, width, 3), np.float32)
    in_camera = room._replace(normals=(room.normals @ camera_from_world[:3, :3].T).astype(np.float32))
    surface = np.concatenate([room.owner, np.full(len(coat.faces), len(room.levels), np.int32)])
    _shade(view_face, inverse_corners, np.asarray(focal_center, float), surface, in_camera, coat, out)
    return out


@njit(cache=True, error_model="numpy")
def _shade(view_face, inverse_corners, focal_center, surface, room, coat, out):
    """Add the light of every pixel to ``out``; the room's normals are in camera axes."""
    height, width, _ = out.shape
    fx, fy, cx, cy = focal_center
    pixel = np.empty(3, np.float32)
    bounds = _shadow_bounds(coat.shadow, focal_center, height, width)
    room_faces = room.corners.shape[0]
    for i in range(height):
        for j in range(width):
            first = view_face[2 * i, 2 * j]
            same = first >= 0
            for k in range(1, 4):
                other = view_face[2 * i + k // 2, 2 * j + k % 2]
                same = same and other >= 0 and surface[other] == surface[first]
            count = 1 if same else 4
            for k in range(count):
                face = view_face[2 * i + k // 2, 2 * j + k % 2]
                if face < 0:
                    continue
                x = (j + 0.5 - cx) / fx if same else (j + 0.25 + 0.5 * (k % 2) - cx) / fx
                y = (i + 0.5 - cy) / fy if same else (i + 0.25 + 0.5 * (k // 2) - cy) / fy
                inverse = inverse_corners[face]
                a = inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]
                b = inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]
                c = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
                z = 1.0 / max(a + b + c, 0.05)
                a, b, c = a * z, b * z, c * z
                if face >= room_faces:
                    _fur(coat.faces[face - room_faces], a, b, c, coat, z / fx, pixel)
                else:
                    _sample(face, a, b, c, x, y, z, fx, surface[face], room, pixel)
                    if bounds[0] <= i < bounds[1] and bounds[2] <= j < bounds[3]:
                        dark = _shadow(x * z, y * z, z, room.normals[face], coat.shadow)
                        for channel in range(3):
                            pixel[channel] *= dark
                for channel in range(3):
                    out[i, j, channel] += pixel[channel] / count


@njit(cache=True, error_model="numpy")
def _sample(face, a, b, c, x, y, z, fx, sheet, room, pixel):
    """Sample the sheet's picture with trilinear filtering into ``pixel`` (linear)."""
    corners, atlas, levels, normals = room.corners, room.atlas, room.levels, room.normals
    u = a * corners[face, 0, 0] + b * corners[face, 1, 0] + c * corners[face, 2, 0]
    v = a * corners[face, 0, 1] + b * corners[face, 1, 1] + c * corners[face, 2, 1]
    slope = abs(normals[face, 0] * x + normals[face, 1] * y + normals[face, 2]) / np.sqrt(x * x + y * y + 1.0)
    footprint = z / fx * room.texels_per_m[sheet] / np.sqrt(max(slope, 0.12))
    level = min(max(np.log2(max(footprint, 1e-3)), 0.0), 6.0)
    low = int(level)
    blend = level - low
    pixel[0] = pixel[1] = pixel[2] = 0.0
    for step in range(2):
        weight = (1.0 - blend) if step == 0 else blend
        if weight <= 0:
            continue
        start, rows, columns = levels[sheet, low + step]
        p, q = min(max(u * columns - 0.5, 0.0), columns - 1.0), min(max(v * rows - 0.5, 0.0), rows - 1.0)
        j0, i0 = int(p), int(q)
        j1, i1 = min(j0 + 1, columns - 1), min(i0 + 1, rows - 1)
        s, t = p - j0, q - i0
        above, below = start + i0 * columns * 3, start + i1 * columns * 3
        for channel in range(3):
            left, right = j0 * 3 + channel, j1 * 3 + channel
            upper = (1 - s) * atlas[above + left] + s * atlas[above + right]
            lower = (1 - s) * atlas[below + left] + s * atlas[below + right]
            pixel[channel] += weight * ((1 - t) * upper + t * lower)
    for channel in range(3):
        root = pixel[channel] / 255.0
        pixel[channel] = RADIANCE_RANGE * root * root


@njit(cache=True, error_model="numpy")
def _fur(corner, a, b, c, coat, footprint, pixel):
    """Blend base color and light, and add the fine fur that the footprint (meters a pixel) can resolve."""
    rest, light, pattern = coat.rest, coat.light, coat.pattern
    a, b, c = max(a, 0.0), max(b, 0.0), max(c, 0.0)
    total = a + b + c
    a, b, c = a / total, b / total, c / total
    p, q, r = corner
    x = a * rest[p, 0] + b * rest[q, 0] + c * rest[r, 0]
    y = a * rest[p, 1] + b * rest[q, 1] + c * rest[r, 1]
    z = a * rest[p, 2] + b * rest[q, 2] + c * rest[r, 2]
    strength = a * pattern[p, 3] + b * pattern[q, 3] + c * pattern[r, 3]
    resolved, grain = min(1.0, 0.004 / max(footprint, 1e-4)), _grain(x, y, z, 90.0) * 0.8
    fine = strength * resolved * (grain + _grain(x, y, z, 230.0) * 0.5)
    for channel in range(3):
        base = a * pattern[p, channel] + b * pattern[q, channel] + c * pattern[r, channel]
        shine = a * light[p, channel] + b * light[q, channel] + c * light[r, channel]
        pixel[channel] = max(base * (1.0 + fine), 0.004) * shine


@njit(cache=True, error_model="numpy")
def _grain(x, y, z, frequency):
    """Return solid value noise in about [-1, 1]."""
    x, y, z = x * frequency, y * frequency, z * frequency * 0.45
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    s, t, r = x - i, y - j, z - k
    total = 0.0
    for corner in range(8):
        di, dj, dk = corner & 1, (corner >> 1) & 1, corner >> 2
        mixed = (i + di) * 73856093 ^ (j + dj) * 19349663 ^ (k + dk) * 83492791
        mixed = (mixed ^ (mixed >> 13)) * 1274126177
        value = ((mixed ^ (mixed >> 16)) & 1023) / 511.5 - 1.0
        total += value * (s if di else 1 - s) * (t if dj else 1 - t) * (r if dk else 1 - r)
    return total


@njit(cache=True, error_model="numpy")
def _shadow(x, y, z, normal, shadow):
    """Return the share of light left at a surface point near the balls (analytic sphere occlusion)."""
    lost = 0.0
    sign = -1.0 if normal[0] * x + normal[1] * y + normal[2] * z > 0 else 1.0
    for ball in range(shadow.shape[0]):
        dx, dy, dz = shadow[ball, 0] - x, shadow[ball, 1] - y, shadow[ball, 2] - z
        squared = dx * dx + dy * dy + dz * dz
        facing = sign * (normal[0] * dx + normal[1] * dy + normal[2] * dz) / np.sqrt(squared)
        if facing > 0:
            lost += facing * min(shadow[ball, 3] * shadow[ball, 3] / squared, 0.9)
    return max(1.0 - 1.15 * lost, 0.25)


@njit(cache=True, error_model="numpy")
def _shadow_bounds(shadow, focal_center, height, width):
    """Return rows and columns within which the balls may darken the room."""
    fx, fy, cx, cy = focal_center
    top, bottom, left, right = height, 0, width, 0
    for ball in range(shadow.shape[0]):
        z = shadow[ball, 2]
        if z < 0.1:
            continue
        reach = 5.0 * shadow[ball, 3] / z
        x, y = shadow[ball, 0] / z, shadow[ball, 1] / z
        top, bottom = min(top, int((y - reach) * fy + cy)), max(bottom, int((y + reach) * fy + cy))
        left, right = min(left, int((x - reach) * fx + cx)), max(right, int((x + reach) * fx + cx))
    return max(top, 0), min(bottom, height), max(left, 0), min(right, width)
