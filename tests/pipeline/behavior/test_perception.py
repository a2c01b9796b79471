from dataclasses import replace

import numpy as np
import torch

from pipeline.behavior.model import BehaviorNets
from pipeline.behavior.perception import VELOCITY_CHANNELS, FeatureVolume, VolumeScene, world_from_ego
from pipeline.behavior.planning import observe
from pipeline.behavior.trajectories import Context
from pipeline.geometry import rigid
from tests.pipeline.behavior.wandering import ARCHITECTURE, REST, room, wandering


def heading(yaw: float, pitch: float = 0.0) -> np.ndarray:
    turn = rigid.rotation_from_vector(np.array([0, yaw, 0])) @ rigid.rotation_from_vector(
        np.array([pitch, 0, 0])
    )
    return rigid.make(turn, np.array([1.0, 0.2, -0.5]))


def test_ego_frame_has_the_heading_and_is_upright():
    frame = world_from_ego(heading(0.7, pitch=-0.5), "yaw")
    np.testing.assert_allclose(frame[:3, 1], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(frame, heading(0.7), atol=1e-9)
    np.testing.assert_allclose(world_from_ego(heading(0.7, -0.5), "full"), heading(0.7, -0.5))


def test_heading_is_defined_for_vertical_roots():
    for pitch in (-np.pi / 2, np.pi / 2):
        np.testing.assert_allclose(world_from_ego(heading(0.7, pitch), "yaw"), heading(0.7), atol=1e-6)


def test_grid_reads_the_voxel_at_each_point():
    features = np.zeros((2, 20, 20, 20), np.float16)
    features[1, 12, 3, 15] = 0.5
    volume = FeatureVolume(features, np.zeros((20, 20, 20), np.uint8), np.zeros(3), 0.1)
    grid = volume.around(rigid.make(np.eye(3), np.array([[1.0, 0.5, 1.0]])))
    found = np.argwhere(grid[0, 1] > 0)
    np.testing.assert_array_equal(found, [[32 + 2, 4 - 2, 32 + 5]])
    assert grid[0, 1].max() == 0.5


def test_observations_are_invariant_to_the_world_frame():
    data, volume = wandering(), room()
    context, _ = data.windows(np.array([3, 50]))
    quarter = rigid.make(rigid.rotation_from_vector(np.array([0, np.pi / 2, 0])), np.zeros(3))
    turned_volume = FeatureVolume(
        np.rot90(volume.features, 1, (3, 1)), np.rot90(volume.occupancy, 1, (2, 0)), volume.origin, 0.1
    )
    turned = Context(
        quarter @ context.world_from_agent,
        context.agent_from_bone,
        rigid.apply(quarter, context.observer_world),
        observer_rotation=quarter[:3, :3] @ context.observer_rotation,
    )
    before, after = observe(context, volume, REST, "yaw"), observe(turned, turned_volume, REST, "yaw")
    np.testing.assert_allclose(after.others, before.others, atol=1e-5)
    np.testing.assert_allclose(after.past, before.past, atol=1e-5)
    assert (after.scene_grid == before.scene_grid).mean() > 0.999  # points on voxel borders are ambiguous


def person(track: torch.Tensor, kind: float = 0.0) -> torch.Tensor:
    return torch.nn.functional.pad(track, (0, 7), value=kind)[None, None]


def test_distant_observer_equals_none_and_a_near_one_does_not():
    nets = BehaviorNets(ARCHITECTURE).eval()
    encode = next(iter(nets.perception)).others
    track = torch.linspace(1, 0, 8)[:, None] * torch.tensor([[0.5, 0.0, 0.5]]) + torch.tensor(
        [[0.0, 1.3, 1.0]]
    )
    near, far = (person(track + torch.tensor([0.0, 0.0, off])) for off in (0.0, 3.5))
    none = encode(near, torch.zeros(1))
    torch.testing.assert_close(encode(far, torch.ones(1)), none)
    torch.testing.assert_close(encode(person(track + torch.tensor([0.0, 0.0, 7.0])), torch.ones(1)), none)
    assert (encode(near, torch.ones(1)) - none).abs().max() > 1e-3


def test_observer_rotation_matters_only_with_pose_observers():
    context, _ = wandering().windows(np.array([3]))
    known = replace(context, observer_world=context.world_from_agent[..., :3, 3] + [0.8, 1.0, 0.3])
    unknown = replace(known, observer_rotation=None)
    codes = {}
    for kind in ("positions", "poses"):
        encode = next(iter(BehaviorNets(replace(ARCHITECTURE, observed_past=kind)).perception)).others
        turned, looking = (
            torch.from_numpy(observe(each, room(), REST, "yaw").others) for each in (known, unknown)
        )
        codes[kind] = [encode(past, torch.ones(1)) for past in (turned, looking)]
        none = encode(turned, torch.zeros(1))
        nobody = turned.clone()
        nobody[..., 0] = 1000.0
        torch.testing.assert_close(encode(nobody, torch.ones(1)), none)
        assert not torch.equal(codes[kind][0], none)
    torch.testing.assert_close(*codes["positions"], atol=1e-6, rtol=0)
    assert (codes["poses"][0] - codes["poses"][1]).abs().max() > 1e-3


def test_observer_without_rotation_faces_the_agent():
    context, _ = wandering().windows(np.array([3, 50]))
    unknown = replace(context, observer_rotation=None)
    pose, agent = unknown.world_from_observer, context.world_from_agent[..., :3, 3]
    seen = rigid.apply(rigid.inverse(pose), agent[..., None, :])[..., 0, :]
    np.testing.assert_allclose(seen[..., :2], 0, atol=1e-9)
    np.testing.assert_allclose(seen[..., 2], np.linalg.norm(agent - context.observer_world, axis=-1))
    assert (pose[..., 1, 1] < 0).all(), "the camera's y axis points down"


ACCOMPANIED = replace(ARCHITECTURE, companions=True)


def equal_codes(code: torch.Tensor) -> list[bool]:
    """Return whether the codes of two agents agree in scene, observer and past; speed and posture agree where
    the past does.
    """
    now = VELOCITY_CHANNELS + ACCOMPANIED.body_channels
    maps = ACCOMPANIED.condition_length - ACCOMPANIED.code_length
    charts, codes, posture = code.split([maps, ACCOMPANIED.code_length - now, now], dim=1)
    members = codes.unflatten(1, (ACCOMPANIED.ensemble_size, -1))
    parts = members[..., : 3 * ACCOMPANIED.code].unflatten(-1, (3, -1))
    attended = members[..., 3 * ACCOMPANIED.code :]
    same = ((parts[0] - parts[1]).abs().amax((0, 2)) < 1e-7).tolist()
    assert bool((attended[0] == attended[1]).all()) == same[1]
    assert bool((charts[0] == charts[1]).all()) == same[0]
    assert bool((posture[0] == posture[1]).all()) == same[2]
    return same


def test_ablated_input_does_not_reach_the_code():
    inputs = [
        torch.randn(2, 16, 64, 8, 64),
        torch.rand(2, 1, 8, 10),
        torch.randn(2, 8 * (9 + 18)),
        torch.ones(2, 3),
    ]
    for number, blind in enumerate(("scene", "observer", "past")):
        whole = BehaviorNets(replace(ACCOMPANIED, ablated_input=blind)).perception(*inputs)
        assert equal_codes(whole) == [k == number for k in range(3)]


def test_dropped_conditions_do_not_reach_the_code():
    nets = BehaviorNets(ACCOMPANIED).eval()
    inputs = [torch.randn(2, 16, 64, 8, 64), torch.rand(2, 1, 8, 10), torch.randn(2, 8 * (9 + 18))]
    nothing = nets.perception(*inputs, torch.zeros(2, 3))
    torch.testing.assert_close(nothing[0], nothing[1])
    for number in range(3):
        keep = torch.zeros(2, 3)
        keep[:, number] = 1
        assert equal_codes(nets.perception(*inputs, keep)) == [k != number for k in range(3)]


def test_scenes_encoded_in_chunks_have_the_same_codes_and_gradients(monkeypatch):
    torch.manual_seed(0)
    net, grid, found = VolumeScene(3, 8, 4), torch.randn(5, 3, 64, 8, 64), []
    monkeypatch.setattr(VolumeScene, "CHUNK", 2)
    for mode in (True, False):
        net.train(mode).zero_grad()
        _, code = net(grid)
        code.square().sum().backward()
        found.append([code, *(parameter.grad for parameter in net.parameters())])
    for ours, whole in zip(*found, strict=True):
        torch.testing.assert_close(ours, whole)
