import numpy as np
import torch

from pipeline.behavior.model import channels_from_bones
from pipeline.geometry import rigid
from pipeline.longterm.bodies import PosedSurface, PoseSpace
from tests.pipeline.longterm import strider


def test_surface_is_linear_blend_skinning():
    body, moving = strider.body(), strider.striding(np.array([[0.8, 0, -1.0], [0.8, 0, 1.0]]), 2.0)
    weights = np.random.default_rng(0).dirichlet(np.ones(5), len(body.mesh.vertices))
    body = type(body)(body.mesh, weights, body.agent_from_bone_rest, body.shape)
    posed = PosedSurface(body)(*moving.tensors()).numpy()
    agent_from_rest = moving.agent_from_bone @ rigid.inverse(body.agent_from_bone_rest)
    for frame in (0, 31):
        each = rigid.apply(agent_from_rest[frame], body.mesh.vertices.astype(float))  # bone vertex 3
        mixed = np.einsum("vb,bvi->vi", weights, each)
        np.testing.assert_allclose(
            posed[frame], rigid.apply(moving.world_from_agent[frame], mixed), atol=1e-5
        )


def test_pose_space_reconstructs_training_poses():
    moving = strider.striding(np.array([[0.8, 0, -1.0], [0.8, 0, 1.0]]), 3.0)
    rest = strider.body().agent_from_bone_rest
    poses = PoseSpace(rest, 12).fit(moving.agent_from_bone)
    channels = torch.from_numpy(channels_from_bones(moving.agent_from_bone, rest)).float()
    p = poses.encode(channels)
    assert float(poses.explained) > 0.999
    torch.testing.assert_close(poses.decode(p), channels, atol=2e-3, rtol=0)
    torch.testing.assert_close(
        poses.bones(channels), torch.from_numpy(moving.agent_from_bone).float(), atol=1e-5, rtol=0
    )
    used = p.std(0) > 0.5  # components without variance are zero
    assert used.sum() >= 3
    torch.testing.assert_close(p[:, used].std(0), torch.ones(int(used.sum())), atol=0.02, rtol=0)


def test_sampled_vertices_cover_the_body():
    body = strider.body()
    chosen = body.sample_vertices(12)
    assert len(set(chosen.tolist())) == 12
    away = np.linalg.norm(body.mesh.vertices[:, None] - body.mesh.vertices[chosen], axis=-1).min(1)
    assert away.max() < 0.17
