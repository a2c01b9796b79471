"""Pictures for the report: trajectories and occupancy of animal and person in the room."""

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import gaussian_filter, maximum_filter

from pipeline.behavior.trajectories import UP
from pipeline.geometry import cameras, rigid, views
from pipeline.geometry.meshes import Mesh, RayCaster, render_view
from stages.export_simulator.actions import SessionClip

_ANIMAL, _OBSERVER = (200, 114, 43), (47, 111, 159)
_HEADROOM_M = 1.9
_BLUR_M = 0.06
_CELL_M, _CLOUD_M = 0.06, 0.12
"""edge of the cells of densities in space, and the standard deviation over which they are smoothed"""
_FROM = np.array([0.25, 1.1, 0.4])
"""where a view of the room is taken from, in diagonals of the room from its middle"""
_EXTENT = (0.002, 0.998)
"""quantiles of the heights and sides of vertices between which the room lies"""
_HEAT_SIZE = (360, 480)
"""height and width of a view of the room, pixels"""
_PALE = 0.45
"""share of the room's colors that is left under what is laid over it"""


def heat_maps(mesh: Mesh, floor_m: float, motions: list[SessionClip]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw trajectories (top) and their density in space (bottom) of animal and person in the room (Fig. 13).

    They are seen from a corner, without what is above head height; surfaces hide what is behind them.
    """
    low, high = np.quantile(mesh.vertices, _EXTENT, axis=0)
    below = (mesh.vertices[mesh.faces, 1] < floor_m + _HEADROOM_M).all(1)
    caster = RayCaster(Mesh(mesh.vertices, mesh.faces[below], mesh.color))
    center, reach = (low + high) / 2 * [1, 0, 1] + [0, floor_m, 0], np.linalg.norm((high - low)[[0, 2]])
    camera = rigid.look_at(center + reach * _FROM, center, UP)
    height, width = _HEAT_SIZE
    lens = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]])
    depth, hits = render_view(caster, camera, lens, height, width)
    room = _PALE * views.shade(caster.mesh, hits).reshape(height, width, 3) + (1 - _PALE) * views.BACKGROUND
    behind = np.where(depth > 0, depth, np.inf).reshape(height, width)
    columns = []
    for name, tint in (("world_from_agent", _ANIMAL), ("world_from_camera", _OBSERVER)):
        points = np.concatenate([getattr(motion, name)[:, :3, 3] for motion in motions])
        cells = np.ceil((np.ptp(points, axis=0) + 6 * _CLOUD_M) / _CELL_M).astype(int)
        edges = [points[:, k].min() - 3 * _CLOUD_M + _CELL_M * np.arange(cells[k] + 1) for k in range(3)]
        density = gaussian_filter(np.histogramdd(points, edges)[0], _CLOUD_M / _CELL_M)
        filled = np.argwhere(density > 0.01 * density.max())
        places = np.stack([edges[k][filled[:, k]] + _CELL_M / 2 for k in range(3)], axis=-1)
        heat = _splatted(places, density[tuple(filled.T)] / density.max(), camera, lens, behind)
        track = _splatted(points, np.ones(len(points)), camera, lens, behind, radius_px=2)
        glow = matplotlib.colormaps["inferno"](np.sqrt(heat))[..., :3] * 255
        share = (1 - _PALE / 2) * np.sqrt(heat)[..., None]
        lines = np.where(track[..., None] > 0, tint, room)
        columns.append(np.concatenate([lines, (1 - share) * room + share * glow]))
    return np.rint(np.concatenate(columns, axis=1)).astype(np.uint8)


def _splatted(
    points: Float[np.ndarray, "point 3"],
    values: Float[np.ndarray, "point"],
    world_from_camera: Float[np.ndarray, "4 4"],
    intrinsics: Float[np.ndarray, "3 3"],
    behind: Float[np.ndarray, "height width"],
    radius_px: int = 4,
) -> Float[np.ndarray, "height width"]:
    """Splat the values of visible points into the picture, keeping the maximum per pixel."""
    pixel, depth = cameras.project(rigid.apply(rigid.inverse(world_from_camera), points), intrinsics)
    visible = depth < cameras.sample_nearest(behind, pixel) + _CELL_M
    visible &= cameras.in_picture(pixel, depth, behind.shape)
    image = np.zeros(behind.shape)
    np.maximum.at(image, cameras.pixel_index(pixel[visible]), values[visible])
    return maximum_filter(image, 2 * radius_px - 1)


def visits(mesh: Mesh, floor_m: float, motions: list[SessionClip]) -> UInt8[np.ndarray, "height width 3"]:
    """Overlay the time that animal (amber) and person (blue) spent in each place on the pale room."""
    room = views.bird_view(mesh, floor_m=floor_m, height_m=_HEADROOM_M)
    image = _PALE * room.image + (1 - _PALE) * views.BACKGROUND
    edges = [np.arange(side + 1) for side in image.shape[1::-1]]
    for name, tint in (("world_from_camera", _OBSERVER), ("world_from_agent", _ANIMAL)):
        pixel = room.pixel(np.concatenate([getattr(motion, name)[:, :3, 3] for motion in motions]))
        heat = np.histogram2d(*pixel.T, bins=edges)[0].T
        heat = gaussian_filter(heat, _BLUR_M * room.meter_px)
        share = 0.85 * np.sqrt(heat / max(heat.max(), 1e-12))[..., None]
        image = (1 - share) * image + share * np.array(tint)
    return np.rint(image).astype(np.uint8)
