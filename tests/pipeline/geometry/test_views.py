"""Bird's-eye views place points correctly."""

import numpy as np
import trimesh

from pipeline.geometry import views
from pipeline.geometry.meshes import Mesh


def test_bird_view_shows_a_colored_box_at_its_position():
    floor = trimesh.creation.box((4, 0.02, 3)).subdivide_to_size(0.3)
    box = trimesh.creation.box((0.6, 0.4, 0.6), trimesh.transformations.translation_matrix((1.0, 0.2, -0.5)))
    color = np.repeat(
        np.array([[200, 200, 200], [250, 20, 20]], np.uint8), [len(floor.vertices), len(box.vertices)], axis=0
    )
    both = trimesh.util.concatenate([floor, box])
    view = views.bird_view(
        Mesh(both.vertices.astype(np.float32), both.faces.astype(np.int32), color), floor_m=0.0
    )
    column, row = view.pixel(np.array([[1.0, 0.4, -0.5]]))[0].astype(int)
    assert tuple(view.image[row, column]) == (250, 20, 20)
    column, row = view.pixel(np.array([[-1.0, 0.0, 0.5]]))[0].astype(int)
    assert tuple(view.image[row, column]) == (200, 200, 200)
    before = view.image.copy()
    view.draw(np.array([[-1.0, 0, 0], [-0.5, 0, 0], [np.nan] * 3, [0.5, 0, 0.9], [0.5, 0, 0.5]]), (0, 0, 255))
    changed = (view.image != before).any(-1)
    gap = view.pixel(np.array([[0.0, 0, 0.45]]))[0].astype(int)
    assert changed.any()
    assert not changed[gap[1], gap[0]], "the gap stays open"
