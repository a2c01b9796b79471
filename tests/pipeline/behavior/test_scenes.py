from dataclasses import replace

import numpy as np

from pipeline.behavior.scenes import SceneConstraint, Scenes
from pipeline.behavior.support import Support, mark_supported
from pipeline.geometry import rigid
from tests.pipeline.behavior.wandering import room


def test_points_are_projected_to_the_nearest_free_space():
    scenes, rng = Scenes.of(room()), np.random.default_rng(0)
    points = rng.uniform([-3, -0.5, -3], [3, 1.5, 3], (2, 400, 3))
    moved, solid = scenes.out_of_solid(points, None), scenes.inside_solid(points, None)
    assert solid.any()
    assert not scenes.inside_solid(moved, None).any()
    np.testing.assert_array_equal(moved[~solid], points[~solid])
    low, high = np.array([-2.0, 0.0, -2.0]), np.array([2.0, 1.0, 2.0])
    outside = np.linalg.norm(points - points.clip(low, high), axis=-1)
    assert (np.linalg.norm(moved - points, axis=-1) - outside < 0.1 * np.sqrt(3))[
        solid
    ].all()  # the edges of two voxels


def test_free_space_projection_uses_the_frame_of_each_agent():
    world_from_ego = rigid.make(
        rigid.rotation_from_vector(np.array([[0, 0.5, 0], [0, -2.0, 0]])),
        np.array([[1, 0.3, 0], [-1, 0.3, 1]]),
    )
    ground = SceneConstraint(Scenes.of(room()), world_from_ego, None)
    away = np.tile(np.linspace([0, 0, 0], [0, 0, 4], 20), (6, 1, 1))  # three plans each, through a wall
    out_of_solid = ground.out_of_solid(away)
    world = rigid.apply(np.repeat(world_from_ego, 3, axis=0), out_of_solid)
    assert not ground.scenes.inside_solid(world, None).any()
    np.testing.assert_allclose(out_of_solid[:, :5], away[:, :5], atol=1e-9)


def test_goals_and_paths_are_placed_on_support_in_the_frame_of_each_agent():
    scene, range_m = room(), np.array([[0.15, 0.2], [0.18, 0.2]])
    marks = mark_supported(scene.occupancy != 1, scene.occupancy)
    scenes = replace(Scenes.of(scene), supports=(Support.of(scene, marks, range_m),))
    world_from_ego = rigid.make(
        rigid.rotation_from_vector(np.array([[0, 0.5, 0], [0, -2.0, 0]])),
        np.array([[1, 0.3, 0], [-1, 0.3, 1]]),
    )
    ground, rng = SceneConstraint(scenes, world_from_ego, None), np.random.default_rng(0)
    plans = np.repeat(world_from_ego, 3, axis=0)
    goals = rng.normal(0, 0.2, (6, 3))
    world = rigid.apply(plans, ground.goals_on_support(goals, np.zeros((6, 3)))[:, None])[:, 0]
    free = rigid.apply(plans, goals[:, None])[:, 0]
    np.testing.assert_allclose(world[:, [0, 2]], free[:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(world[:, 1], free[:, 1].clip(0.15, 0.2), atol=1e-9)
    start, path = np.zeros((6, 3)), np.cumsum(rng.normal(0, 0.02, (6, 30, 3)), axis=1)
    on_support = rigid.apply(plans, ground.on_support(path, start))
    assert (on_support[:, :, 1] >= 0.15 - 1e-9).all() and (
        on_support[:, 5:, 1] <= 0.2 + 1e-9
    ).all()  # starts in the air


def test_goals_in_walls_are_rotated_to_free_space_at_the_same_distance():
    scenes = Scenes.of(room())  # 4 m by 4 m about the origin
    start = np.tile([1.5, 0.3, 0.0], (2, 1))
    goals = start + np.array([[1.0, 0.0, 0.1], [9.0, 0.0, 0.0]])
    wall, outside = SceneConstraint(scenes, np.eye(4)[None], None).goals_on_support(goals, start)
    assert not scenes.inside_solid(np.stack([wall, outside])[:, None], None).any()
    assert np.isclose(np.linalg.norm(wall - start[0]), np.hypot(1.0, 0.1))
    assert wall[2] > 0.1, "to the side that is nearer"
    np.testing.assert_allclose(
        outside, [2.0, 0.3, 0.0], atol=0.01
    )  # no free space at that distance: the nearest is used
