"""Pictures for the report: the room as the page shows it from above, and where animal and person
have been.
"""

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import gaussian_filter

from pipeline.geometry.meshes import Mesh, RayCaster
from stages.export_simulator.actions import SessionClip
from stages.export_simulator.contract import RoomExtent

_PAPER = np.array([245, 242, 236], np.float32)
_ANIMAL = np.array([200, 114, 43], np.float32)
_OBSERVER = np.array([47, 111, 159], np.float32)
_HEADROOM_M = 1.9
_BLUR_M = 0.06


def from_above(mesh: Mesh, setting: RoomExtent, pixel_m: float = 0.01) -> Float[np.ndarray, "height width 3"]:
    """Look straight down, +x right and +z down, from 1.9 m above the floor: sRGB 0..255, paper where nothing
    is.
    """
    x, z = _pixel_centres(setting, pixel_m)
    top = setting.floor_m + _HEADROOM_M
    origins = np.stack(
        [
            np.broadcast_to(x, (len(z), len(x))),
            np.full((len(z), len(x)), top),
            np.broadcast_to(z[:, None], (len(z), len(x))),
        ],
        -1,
    )
    hits = RayCaster(mesh).cast(
        origins.reshape(-1, 3), np.broadcast_to([0.0, -1.0, 0.0], (x.size * z.size, 3))
    )
    color = np.full((len(mesh.vertices), 3), 190, np.uint8) if mesh.color is None else mesh.color
    seen = np.where((hits.face >= 0)[:, None], hits.interpolate(mesh, color), _PAPER)
    return seen.reshape(len(z), len(x), 3).astype(np.float32)


def visits(
    mesh: Mesh, setting: RoomExtent, motions: list[SessionClip], pixel_m: float = 0.01
) -> UInt8[np.ndarray, "height width 3"]:
    """Lay over the pale room how long the animal (amber) and the person (blue) were where."""
    image = 0.45 * from_above(mesh, setting, pixel_m) + 0.55 * _PAPER
    for name, tint in (("world_from_camera", _OBSERVER), ("world_from_agent", _ANIMAL)):
        places = np.concatenate([getattr(motion, name)[:, [0, 2], 3] for motion in motions])
        edges = [centres - pixel_m / 2 for centres in _pixel_centres(setting, pixel_m)]
        edges = [np.append(edge, edge[-1] + pixel_m) for edge in edges]
        heat = np.histogram2d(places[:, 1], places[:, 0], bins=(edges[1], edges[0]))[0]
        heat = gaussian_filter(heat, _BLUR_M / pixel_m)
        share = 0.85 * np.sqrt(heat / max(heat.max(), 1e-12))[..., None]
        image = (1 - share) * image + share * tint
    return np.rint(image).astype(np.uint8)


def _pixel_centres(setting: RoomExtent, pixel_m: float) -> list[Float[np.ndarray, " pixel"]]:
    """Return the places of pixel columns (x) and rows (z), metres in the world."""
    (low, high), margin = setting.bounds_m[:, [0, 2]], 0.1
    return [np.arange(first - margin, last + margin, pixel_m) for first, last in zip(low, high, strict=True)]
