"""The pictures of the scene template show the room, not its outside."""

import numpy as np
import trimesh

from pipeline.geometry.meshes import Mesh
from stages.build_scene_template.pictures import turntable

RED = (200, 30, 30)


def test_a_closed_room_is_seen_from_above():
    """The walls and the ceiling between the eye and the red floor are left out in all four views."""
    box = trimesh.creation.box((4.0, 2.5, 3.0)).subdivide().subdivide()
    floor = box.vertices[:, 1] < -1.2
    color = np.where(floor[:, None], RED, (90, 90, 90)).astype(np.uint8)
    inside = Mesh(np.asarray(box.vertices), np.asarray(box.faces)[:, ::-1], color)
    picture = turntable(inside).astype(int)
    height, width = picture.shape[0] // 2, picture.shape[1] // 2
    red = picture[..., 0] - picture[..., 1] > 100
    views = red[: 2 * height, : 2 * width].reshape(2, height, 2, width)
    assert (views.mean((1, 3)) > 0.1).all(), "share of each view"
