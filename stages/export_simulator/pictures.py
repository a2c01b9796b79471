"""Pictures for the report: where animal and person have been in the room, from above."""

import numpy as np
from jaxtyping import UInt8
from scipy.ndimage import gaussian_filter

from pipeline.geometry import views
from pipeline.geometry.meshes import Mesh
from stages.export_simulator.actions import SessionClip

_ANIMAL, _OBSERVER = (200, 114, 43), (47, 111, 159)
_HEADROOM_M = 1.9
_BLUR_M = 0.06
_PALE = 0.45
"""share of the room's colours that is left under what is laid over it"""


def visits(mesh: Mesh, floor_m: float, motions: list[SessionClip]) -> UInt8[np.ndarray, "height width 3"]:
    """Lay over the pale room how long the animal (amber) and the person (blue) were where."""
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
