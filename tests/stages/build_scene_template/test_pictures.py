"""Pictures of the scene template show the interior of the room."""

import numpy as np
import trimesh

from pipeline.geometry.meshes import Mesh
from stages.build_scene_template.pictures import turntable

RED = (200, 30, 30)


def test_closed_room_is_visible_from_above():
    """Walls and ceiling in front of the red floor are culled in all four views."""
    box = trimesh.creation.box((4.0, 2.5, 3.0)).subdivide().subdivide()
    floor = box.vertices[:, 1] < -1.2
    color = np.where(floor[:, None], RED, (90, 90, 90)).astype(np.uint8)
    inside = Mesh(np.asarray(box.vertices), np.asarray(box.faces)[:, ::-1], color)
    picture = turntable(inside).astype(int)
    height, width = picture.shape[0] // 2, picture.shape[1] // 2
    red = picture[..., 0] - picture[..., 1] > 100
    views = red[: 2 * height, : 2 * width].reshape(2, height, 2, width)
    assert (views.mean((1, 3)) > 0.1).all(), "share of each view"
