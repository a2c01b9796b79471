"""An animal that sits is told from one that stands, in each frame, though registration has it level."""

import numpy as np
import torch
from jaxtyping import Float

from pipeline.space import cameras, rigid
from stages.reconstruct import assemble, optimise, stances
from stages.reconstruct.assemble import Video
from stages.reconstruct.rays import AGENT, NOT_AGENT, distance_outside
from tests.stages.reconstruct.test_optimise import SHAPES, WIDE, cast, pack, plan, template

FRAMES, SITS = 40, slice(20, 40)
HALF_M = np.array([0.1, 0.1, 0.3])
"""half axes of the animal, an ellipsoid"""


def test_a_stance_must_be_sure_and_lasts():
    level, raised = np.full(6, 0.2), np.full(6, 0.2)
    raised[[1, 3, 4]] -= [0.05, 0.08, 0.08]
    assert stances.likeliest(np.stack([level, raised], -1), 0.2).tolist() == [0, 0, 0, 1, 1, 0]
    assert stances.likeliest(np.stack([level, level - stances.SURE], -1), 0.2).tolist() == [0] * 6


def test_the_better_of_two_misfits_tells_nothing():
    loss = np.tile([0.8, 0.5], (6, 1))
    assert stances.likeliest(loss, 0.39).tolist() == [0] * 6
    assert stances.likeliest(loss, 0.5).tolist() == [1] * 6
    loss[2] = np.nan
    assert stances.likeliest(loss, 0.5).tolist() == [1] * 6, "unseen, it is thought to sit on"


def test_parts_are_told_by_frame():
    found = stances.by_frame(np.array([0, 1, 0]), 25)
    assert found.tolist() == [0] * 10 + [1] * 10 + [0] * 5


def test_sitting_is_found_where_it_is_seen():
    """What is ahead rises by half its length: 30 degrees."""
    found = assemble.build([film(np.random.default_rng(0))], template(HALF_M), SHAPES, 0, "cpu")
    optimise.optimise(found, plan(template=100, scene=2, stance=20, body=2, joint=1))
    raised = found.motion.initial_agent[:, 1, 2]
    assert torch.allclose(raised[SITS], torch.tensor(0.5)) and torch.equal(raised[: SITS.start], torch.zeros(SITS.start))


def film(rng: np.random.Generator) -> Video:
    """Film the animal, first level, then with its front raised, from all around; registration has it level."""
    height, width = WIDE[0] * 4, WIDE[1] * 4
    intrinsics = np.array([[100.0, 0, width / 2], [0, 100.0, height / 2], [0, 0, 1]])
    directions = cameras.ray_directions(intrinsics, height, width).reshape(-1, 3)
    rays, depths, outside, camera, root = [], [], [], [], np.tile(np.eye(4), (FRAMES, 1, 1))
    root[SITS, :3, 1:3] = [[0, 0], [0.75**0.5, 0.5], [-0.5, 0.75**0.5]]
    for frame in range(FRAMES):
        eye = np.array([np.cos(0.4 * frame), 0.3, np.sin(0.4 * frame)])
        camera.append(rigid.look_at(eye, np.zeros(3), np.array([0.0, 1, 0])))
        depth, hit = seen(eye, directions @ camera[-1][:3, :3].T, root[frame, :3, :3])
        chosen = np.concatenate([rng.choice(np.flatnonzero(~hit), 60), rng.choice(np.flatnonzero(hit), 40)])
        rays.append((frame, directions[chosen], depth[chosen], hit[chosen]))
        depths.append(depth.reshape(height, width)[2::4, 2::4])
        outside.append(distance_outside(np.where(hit, AGENT, NOT_AGENT).astype(np.uint8).reshape(height, width), WIDE))
    store, ones = pack(rays, depths, outside, intrinsics, True), np.ones(FRAMES, bool)
    level = np.tile(np.eye(4), (FRAMES, 1, 1))
    return Video("v002", 0.1 * np.arange(FRAMES), np.stack(camera), level, ones.astype(float), ones, True, True, store)


def seen(eye: Float[np.ndarray, "3"], direction: Float[np.ndarray, "ray 3"], turned: Float[np.ndarray, "3 3"]):
    """Return z-depth and whether the animal is hit: in its own axes, each as long as a ball's radius, it is a ball."""
    own = turned / HALF_M
    on_ball, hit = cast_ball(eye @ own, direction @ own)
    on_wall, _ = cast(eye, direction, np.full(3, 9.0))
    return np.where(hit, on_ball, on_wall), hit


def cast_ball(origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "ray 3"]):
    a, b, c = (direction**2).sum(-1), direction @ origin, origin @ origin - 1
    root = b * b - a * c
    return (-b - np.sqrt(np.maximum(root, 0))) / a, root > 0
