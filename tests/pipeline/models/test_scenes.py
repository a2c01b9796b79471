import numpy as np

from pipeline.models.scenes import Ground, Scenes
from pipeline.space import rigid
from tests.pipeline.models.wandering import room


def test_points_are_cleared_by_the_shortest_way_and_free_ones_stay():
    scenes, rng = Scenes.of(room()), np.random.default_rng(0)
    points = rng.uniform([-3, -0.5, -3], [3, 1.5, 3], (2, 400, 3))
    moved, solid = scenes.cleared(points, None), scenes.inside_solid(points, None)
    assert solid.any()
    assert not scenes.inside_solid(moved, None).any()
    np.testing.assert_array_equal(moved[~solid], points[~solid])
    low, high = np.array([-2.0, 0.0, -2.0]), np.array([2.0, 1.0, 2.0])
    outside = np.linalg.norm(points - points.clip(low, high), axis=-1)
    assert (np.linalg.norm(moved - points, axis=-1) - outside < 0.1 * np.sqrt(3))[solid].all()  # the edges of two voxels


def test_ground_clears_in_every_agents_own_frame():
    world_from_ego = rigid.make(rigid.rotation_from_vector(np.array([[0, 0.5, 0], [0, -2.0, 0]])), np.array([[1, 0.3, 0], [-1, 0.3, 1]]))
    ground = Ground(Scenes.of(room()), world_from_ego, None)
    away = np.tile(np.linspace([0, 0, 0], [0, 0, 4], 20), (6, 1, 1))  # three plans each, through a wall
    cleared = ground.cleared(away)
    world = rigid.apply(np.repeat(world_from_ego, 3, axis=0), cleared)
    assert not ground.scenes.inside_solid(world, None).any()
    np.testing.assert_allclose(cleared[:, :5], away[:, :5], atol=1e-9)
