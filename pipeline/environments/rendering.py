"""Top-down view of a life: blocked cells gray, person green, animal blue, others violet, plans and goals
orange.
"""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.core.errors import InputError
from pipeline.environments.world import AnimalWorld

SIDE_PX, SIDE_M = 400, 8.0
"""Side of a picture in pixels, and of what it shows in meters."""
NOSE_M = 0.3
"""Length of the line that points ahead of an animal."""
GROUND, SOLID = (250, 250, 250), (150, 150, 150)
PERSON, ANIMAL, PLAN, OTHER = (85, 168, 104), (59, 110, 165), (221, 132, 82), (139, 98, 183)
"""Colors, RGB."""


def bird_view(world: AnimalWorld, row: int) -> UInt8[np.ndarray, "400 400 3"]:
    """Draw one life, the person in the middle of the picture; world +x is right, +z down."""
    center, scale = world.persons.position[row], SIDE_PX / SIDE_M
    axis = (np.arange(SIDE_PX) + 0.5) / scale - SIDE_M / 2
    x, z = np.meshgrid(axis + center[0], axis + center[1])
    blocked = world.floors[world.scene[row]].blocks(np.stack([x, z], axis=-1))
    picture = np.where(blocked[..., None], SOLID, GROUND).astype(np.uint8)

    def pixel(point: Float[np.ndarray, "2"]) -> tuple[int, int]:
        u, v = np.round((point - center) * scale + SIDE_PX / 2).astype(int)
        return int(u), int(v)

    for name, animals in world.batches.items():
        color = ANIMAL if name == world.target else OTHER
        path = animals.plan.root[row, animals.played[row] :, :3, 3][:, [0, 2]]
        root = animals.past[-1].root[row, 0]
        line = np.array([pixel(point) for point in path], np.int32).reshape(-1, 1, 2)
        cv2.polylines(picture, [line], False, PLAN, 1)
        cv2.circle(picture, pixel(animals.goal[row][[0, 2]]), 4, PLAN, -1)
        nose = root[[0, 2], 3] + NOSE_M * root[[0, 2], 2]
        cv2.line(picture, pixel(root[[0, 2], 3]), pixel(nose), color, 3)
        cv2.circle(picture, pixel(root[[0, 2], 3]), 6, color, -1)
    heading = world.persons.heading[row]
    ahead = np.array([np.sin(heading), np.cos(heading)])
    cv2.line(picture, pixel(center), pixel(center + 0.5 * ahead), PERSON, 2)
    cv2.circle(picture, pixel(center), 8, PERSON, -1)
    return picture


def known_mode(mode: str | None, metadata: dict[str, Any]) -> str | None:
    """Return a render mode that an environment has. Raises REC-002 for others."""
    known = (None, *metadata["render_modes"])
    if mode not in known:
        what = f"{mode!r} is no mode of this environment"
        raise InputError("REC-002", what, "environment: render_mode", f"one of {known}")
    return mode


class PictureWindow:
    """Window that shows pictures; without a display they are drawn but not shown."""

    def __init__(self) -> None:
        import matplotlib.pyplot as plt  # late: only `render_mode="human"` needs a window
        from matplotlib.backends.registry import BackendFilter, backend_registry

        self.library = plt
        interactive = backend_registry.list_builtin(BackendFilter.INTERACTIVE)
        self.visible = plt.get_backend().lower() in {name.lower() for name in interactive}
        self.figure = plt.figure(figsize=(5, 5))
        self.image = self.figure.add_axes((0, 0, 1, 1)).imshow(np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8))

    def show(self, picture: UInt8[np.ndarray, "400 400 3"]) -> None:
        """Replace the picture."""
        self.image.set_data(picture)
        if self.visible:
            self.library.pause(1e-3)

    def close(self) -> None:
        """Close the window."""
        self.library.close(self.figure)
