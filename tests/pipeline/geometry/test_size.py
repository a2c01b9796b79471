"""The length of a body scales with it, and thin tips hardly count."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from pipeline.geometry.meshes import Mesh
from pipeline.geometry.size import body_length_m


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_length_is_that_of_the_body(factor):
    """A ball's area is uniform along each axis; a tail as long as the ball has 2 % of its area."""
    ball = trimesh.creation.icosphere(4, 0.2)
    tail = trimesh.creation.cylinder(
        0.002, 0.4, transform=trimesh.transformations.translation_matrix((0, 0, -0.4))
    )
    whole = trimesh.util.concatenate([ball, tail.subdivide_to_size(0.02)])
    for shape, tolerance_m in ((ball, 0.002), (whole, 0.01)):
        body = Mesh((factor * shape.vertices).astype(np.float32), shape.faces)
        assert abs(body_length_m(body) - 0.95 * 0.4 * factor) < tolerance_m * factor
        across = replace(body, vertices=body.vertices[:, [2, 1, 0]])
        assert body_length_m(across) == pytest.approx(body_length_m(body)), "an axis is mistaken for another"
