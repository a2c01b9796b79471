"""Gaussians cover surfaces, follow bones, survive saving, and improve by optimization."""

from dataclasses import replace

import numpy as np
import torch
import trimesh

from pipeline.fields import gaussians, rasterize
from pipeline.fields.gaussians import Splats, concatenate, render
from pipeline.geometry import rigid_torch
from pipeline.geometry.meshes import Mesh
from stages.refine_gaussians import views


def ball(radius_m: float = 0.5, number: int = 400) -> gaussians.Gaussians:
    surface = trimesh.creation.icosphere(2, radius_m)
    color = np.clip(128 + 200 * surface.vertices, 0, 255).astype(np.uint8)
    mesh = Mesh(surface.vertices.astype(np.float32), surface.faces.astype(np.int32), color)
    return gaussians.from_mesh(mesh, number, np.random.default_rng(0))


def test_gaussians_are_flat_on_the_surface():
    cloud = ball()
    radius = cloud.means.norm(dim=-1)
    assert radius.min() > 0.46 and radius.max() < 0.5001
    thin_axis = rigid_torch.rotation_from_quaternion(cloud.rotation)[..., 2]
    along = (thin_axis * cloud.means / radius[:, None]).sum(-1)
    assert along.min() > 0.95, "the thin axis looks outwards"


def test_file_has_rows_of_248_bytes_without_transparent_gaussians(tmp_path):
    cloud = ball(number=50)
    with torch.no_grad():
        cloud.opacity_logit[3] = -20.0
        cloud.means[5, 0] = torch.nan
    gaussians.save_ply(tmp_path / "a.ply", cloud, gaussians.drawable(cloud))
    data = (tmp_path / "a.ply").read_bytes()
    head = data[: data.index(b"end_header\n") + 11]
    assert b"element vertex 48" in head and len(data) - len(head) == 48 * 248
    back = gaussians.load_ply(tmp_path / "a.ply")
    keep = gaussians.drawable(cloud)
    torch.testing.assert_close(back.means, cloud.means[keep])
    torch.testing.assert_close(back.color, cloud.color[keep])
    torch.testing.assert_close(back.opacity, cloud.opacity[keep])


def test_gaussians_follow_root_and_bones():
    agent, rest = ball(0.2), torch.eye(4).repeat(2, 1, 1)
    splats = Splats(ball(), agent, torch.full((len(agent), 2), 0.5), rest, videos=1)
    motion = rigid_torch.se3_exp(torch.tensor([0.3, -0.8, 0.2, 0.4, 0.1, -0.3]))
    by_root = splats.place_agent(motion, rest, 0)
    by_bones = splats.place_agent(torch.eye(4), motion @ rest, 0)
    torch.testing.assert_close(by_root.means, by_bones.means)
    torch.testing.assert_close(by_root.means, rigid_torch.apply(motion, agent.means))
    expected = motion[:3, :3] @ rigid_torch.rotation_from_quaternion(agent.rotation)
    torch.testing.assert_close(
        rigid_torch.rotation_from_quaternion(by_root.rotation), expected, atol=1e-5, rtol=0
    )


def test_optimization_converges_to_a_known_picture():
    camera = torch.eye(4)
    camera[2, 3] = 1.5
    intrinsics = torch.tensor([[40.0, 0, 20], [0, 40.0, 15], [0, 0, 1]])
    splats = Splats(ball(), ball(0.2), torch.ones(400, 1), torch.eye(4)[None], videos=1)
    with torch.no_grad():
        truth = render(splats.place_scene(0), camera, intrinsics, 30, 40)
        splats.scene.band0 += 0.5 * torch.randn(
            splats.scene.band0.shape, generator=torch.Generator().manual_seed(0)
        )
    optimizer = torch.optim.Adam([splats.scene.band0, splats.appearance], lr=0.03)
    errors = []
    for _ in range(15):
        error = (render(splats.place_scene(0), camera, intrinsics, 30, 40).color - truth.color).abs().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        errors.append(error.item())
    assert errors[-1] < 0.4 * errors[0]
    assert abs(truth.depth[15, 20] - 1.0) < 0.05, "meters: the front of a ball of 0.5 m at 1.5 m"


def test_animal_occludes_the_room():
    splats = Splats(ball(), ball(0.2), torch.ones(400, 1), torch.eye(4)[None], videos=1)
    camera = torch.eye(4)
    camera[2, 3] = 1.5
    root = torch.eye(4)
    root[2, 3] = -0.8
    cloud = concatenate(splats.place_scene(None), splats.place_agent(root, torch.eye(4)[None], None))
    cloud = replace(cloud, log_scale=cloud.log_scale + 0.3)
    view = render(cloud, camera, torch.tensor([[40.0, 0, 20], [0, 40.0, 15], [0, 0, 1]]), 30, 40)
    assert view.agent[15, 20] > 0.9 and view.agent[1, 1] < 0.05


def test_flow_cells_correspond_to_pixels():
    row, column = views.flow_lattice(80, 60, (320, 240), (160, 120))
    assert row[0, 0] == 1 and row[-1, 0] == 159 and column[0, -1] == 119


def test_gaussians_outside_the_view_are_culled():
    splats = Splats(ball(), ball(0.2), torch.ones(400, 1), torch.eye(4)[None], videos=1)
    camera, intrinsics = torch.eye(4), torch.tensor([[40.0, 0, 20], [0, 40.0, 15], [0, 0, 1]])
    camera[0, 3], camera[2, 3] = -0.4, 0.3
    seen = rasterize.in_view(splats.scene.means, splats.scene.log_scale, camera, intrinsics, 30, 40)
    assert 20 < len(seen) < 300
    whole, part = (render(splats.place_scene(0, which), camera, intrinsics, 30, 40) for which in (None, seen))
    torch.testing.assert_close(part.color, whole.color)
    torch.testing.assert_close(part.coverage, whole.coverage)
