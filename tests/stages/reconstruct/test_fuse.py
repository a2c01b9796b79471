"""Fused geometry: shared surfaces, surfaces of single videos, and saving."""

import numpy as np
import pytest
import torch

from pipeline.fields import fields
from pipeline.fields.fields import ArticulatedBody, Field, FieldShape, Reconstruction
from stages.reconstruct.fuse import SceneFuser

LOW, HIGH = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
VOXEL_M = 0.05
BALL = torch.tensor([0.4, 0.3, 0.2])


def fused_scene():
    """Three videos observe a floor at y = -0.5; the last also a red ball where the others observed free
    space.
    """
    fused_scene = SceneFuser((LOW, HIGH), VOXEL_M)
    x, y, z = np.meshgrid(*(np.arange(n * 8 + 1) * 0.05 - 1 for n in fused_scene.size), indexing="ij")
    floor = y + 0.5
    ball = np.sqrt((x - 0.4) ** 2 + (y - 0.3) ** 2 + (z - 0.2) ** 2) - 0.25
    for video in range(3):
        volume = fused_scene.empty()
        distance = np.minimum(floor, ball) if video == 2 else floor
        volume.distance[:] = np.clip(distance / 0.1, -1, 1)
        volume.weight[:] = np.where(distance > -0.1, 1.0, 0.0)
        volume.color[:] = (200, 0, 0) if video == 2 else (0, 0, 200)
        volume.color_weight[:] = np.abs(distance) < 0.05
        fused_scene.add(volume)
    return fused_scene.finish()


def test_floor_is_shared_and_the_ball_belongs_to_one_video():
    fused = fused_scene()
    generator = torch.Generator().manual_seed(0)
    on_floor = torch.rand(200, 3, generator=generator) * 1.6 - 0.8
    on_floor[:, 1] = -0.5 + 0.04 * torch.rand(200, generator=generator)
    direction = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=-1)
    on_ball = BALL + 0.25 * direction
    for video in (-1, 0, 1, 2):
        index = torch.full((200,), video)
        found = fused(on_floor, index)[:, 0] * 0.1
        torch.testing.assert_close(found, on_floor[:, 1] + 0.5, atol=0.004, rtol=0)
        at_ball = fused(on_ball, index)
        if video == 2:
            assert at_ball[:, 0].abs().quantile(0.98) < 0.2, (
                "units of 0.1 m; cells are 5 cm on a ball of 25 cm, slivers are left out"
            )
            assert at_ball[:, 1].quantile(0.02) > 0.7 and at_ball[:, 3].quantile(0.98) < 0.1, (
                "the ball keeps its own color"
            )
        else:
            assert at_ball[:, 0].min() > 0.3, "free, or nearly so, for those who saw through it"
    assert len(fused.blocks) < fused.table[0].numel(), "sparse"


def test_outside_is_free_with_gradients_towards_the_surface():
    fused = fused_scene()
    far = fused(torch.tensor([[5.0, 0, 0], [0, -7.0, 0]]), torch.tensor([0, -1]))
    assert (far[:, 0] == 1).all() and (far[:, 4] == 0).all()
    points = torch.tensor([[0.1, -0.47, -0.3]], requires_grad=True)
    (0.1 * fused(points, torch.tensor([0]))[:, 0]).sum().backward()
    torch.testing.assert_close(points.grad, torch.tensor([[0.0, 1.0, 0.0]]), atol=0.02, rtol=0)


def test_field_on_fused_geometry_survives_saving(tmp_path: pytest.TempPathFactory):
    shape = FieldShape(LOW, HIGH, (0.5,), videos=3, truncation_m=0.1)
    agent = FieldShape(LOW, HIGH, (0.5,))
    body = ArticulatedBody(torch.eye(4).repeat(3, 1, 1), torch.full((3, 3), 0.1), agent)
    fields.save(
        tmp_path, Reconstruction(Field(shape, 0.0, fused_scene()), Field(agent, 0.1), body, ("a", "b", "c"))
    )
    scene = fields.load(tmp_path).scene
    values = scene(BALL[None] + torch.tensor([[0.25, 0, 0]]), torch.tensor([2]))
    assert values.signed_distance.abs() < 0.02 and values.color[0, 0] > 0.7, (
        "untrained heads leave fused colors as they are"
    )
