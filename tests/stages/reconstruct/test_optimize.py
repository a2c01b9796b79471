"""All phases on a ball in a box seen by a moving camera; resumed runs are bit-identical."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import KDTree

from pipeline.fields import fields, marching_cubes
from pipeline.fields.fields import Field, FieldShape, Reconstruction
from pipeline.fields.fused_depth import FusedGeometry
from pipeline.geometry import cameras, rigid, rigid_torch
from pipeline.geometry.meshes import Mesh
from stages.reconstruct import assemble, body, joint, optimize, results
from stages.reconstruct.assemble import AgentTemplate, FieldSizes, RegisteredVideo
from stages.reconstruct.body import Pose
from stages.reconstruct.config import LearningRates, LossWeights, PhaseSteps, RayBatches
from stages.reconstruct.problem import Joints, RaysByFrame
from stages.reconstruct.rays import AGENT, NOT_AGENT, Rays, RayStore, Views, mask_distance_px, occluder_depth

WIDE, UPRIGHT = (24, 32), (32, 24)
"""height and width of thumbnails; pictures are four times larger"""
ROOM_M, RADIUS_M = 1.5, 0.2
SHAPES = FieldSizes(scene_voxel_m=(0.4, 0.2), agent_voxel_m=(0.1, 0.05), width=32)


def cast(origin, direction, world_from_agent, half_m):
    """Return z-depth and the mask of an ellipsoid with these half axes inside a cubic room."""
    with np.errstate(divide="ignore"):
        wall = np.min(
            np.where(direction > 0, (ROOM_M - origin) / direction, (-ROOM_M - origin) / direction), axis=-1
        )
    own = world_from_agent[:3, :3] / half_m
    toward, to_ball = direction @ own, (origin - world_from_agent[:3, 3]) @ own
    a, b, c = (toward**2).sum(-1), (toward * to_ball).sum(-1), (to_ball**2).sum(-1) - 1
    root = b * b - a * c
    near = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
    hit = (near > 0) & (near < wall)
    return np.where(hit, near, wall), hit


def film(id: str, frames: int, has_scene: bool, rng, size=WIDE) -> RegisteredVideo:
    """Render the ball as it moves along x; the world of the turnaround is that of the ball."""
    root = np.tile(np.eye(4), (frames, 1, 1))
    if has_scene:
        root[:, 0, 3] = 0.03 * np.arange(frames)
    registered = root @ rigid.make(np.eye(3), np.array([0.03, -0.03, 0.02])) if has_scene else root
    return film_animal(id, root, registered, RADIUS_M, has_scene, rng, size)


def film_animal(
    id: str, root, registered, half_m: float | np.ndarray, has_scene: bool, rng, size=WIDE
) -> RegisteredVideo:
    """Render an ellipsoid from all around as its root moves; registered roots differ from the true ones."""
    frames = len(root)
    height, width = size[0] * 4, size[1] * 4
    intrinsics = np.array([[100.0, 0, width / 2], [0, 100.0, height / 2], [0, 0, 1]])
    directions = cameras.ray_directions(intrinsics, height, width).reshape(-1, 3)
    rays, depths, outside, camera = [], [], [], []
    for frame in range(frames):
        angle = 0.4 * frame
        eye = np.array([np.cos(angle), 0.3, np.sin(angle)])
        camera.append(rigid.look_at(eye, root[frame, :3, 3], np.array([0.0, 1, 0])))
        depth, hit = cast(eye, directions @ camera[-1][:3, :3].T, root[frame], half_m)
        chosen = np.concatenate([rng.choice(np.flatnonzero(~hit), 60), rng.choice(np.flatnonzero(hit), 40)])
        rays.append((frame, directions[chosen], depth[chosen], hit[chosen]))
        depths.append(depth.reshape(height, width)[2::4, 2::4])
        outside.append(
            mask_distance_px(np.where(hit, AGENT, NOT_AGENT).astype(np.uint8).reshape(height, width), size)
        )
    store = pack(rays, depths, outside, intrinsics, has_scene)
    ones = np.ones(frames, bool)
    return RegisteredVideo(
        id,
        np.arange(frames) * 0.1,
        np.stack(camera),
        registered,
        ones.astype(float),
        ones,
        has_scene,
        has_scene,
        store,
    )


def pack(rays, depths, outside, intrinsics, has_scene: bool) -> RayStore:
    frames, (height, width) = len(depths), depths[0].shape
    frame = torch.cat([torch.full((len(direction),), number) for number, direction, _, _ in rays])
    direction, depth, hit = (torch.from_numpy(np.concatenate([ray[k] for ray in rays])) for k in (1, 2, 3))
    count = len(frame)
    color = torch.where(hit[:, None], torch.tensor([200, 40, 40]), torch.tensor([40, 40, 200])).byte()
    feature = torch.zeros(count, 16, dtype=torch.int8)
    feature[:, 0] = 127
    plain = torch.zeros(count)
    table = Rays(
        frame, direction.float(), depth.float(), torch.full((count,), 0.9), color, feature,
        torch.where(hit, AGENT, 0).byte(), plain[:, None].repeat(1, 2), plain.byte(), plain.to(torch.int8) + 1,
    )  # fmt: skip
    views = Views(
        torch.from_numpy(intrinsics).float().repeat(frames, 1, 1), torch.tensor([width * 4.0, height * 4.0]).repeat(frames, 1),
        torch.from_numpy(np.stack(depths)).half(),
        torch.from_numpy(np.stack(outside)), torch.from_numpy(np.stack(list(map(occluder_depth, depths, outside)))).half(),
        torch.ones(frames, dtype=torch.bool),
    )  # fmt: skip
    return RayStore(
        table.at(torch.nonzero(~hit)[:, 0] if has_scene else torch.zeros(0, dtype=torch.int64)), table, views
    )


def problem(shapes: FieldSizes = SHAPES, videos=None):
    rng = np.random.default_rng(0)
    videos = videos or [film("v002", 12, True, rng), film("v001", 6, False, rng, UPRIGHT)]
    return assemble.build(videos, template(RADIUS_M), shapes, 0, "cpu"), videos


def template(half_m: float | np.ndarray) -> AgentTemplate:
    """Return the template of a ball or of an ellipsoid with these half axes."""
    ball = trimesh.creation.icosphere(2)
    mesh = Mesh(
        (half_m * ball.vertices).astype(np.float32),
        ball.faces.astype(np.int32),
        np.full((len(ball.vertices), 3), [200, 40, 40], np.uint8),
    )
    feature = np.zeros((len(mesh.vertices), 16), np.float32)
    feature[:, 0] = 1
    rest = rigid.make(np.tile(np.eye(3), (6, 1, 1)), 0.1 * np.concatenate([np.eye(3), -np.eye(3)]))
    return AgentTemplate(mesh, feature, rest, np.full((6, 3), 0.1))


def plan(resume=None, **steps) -> optimize.OptimizationPlan:
    batches = RayBatches(scene_rays=256, joint_scene_rays=128, rendered_rays=16, runs=2)
    return optimize.OptimizationPlan(PhaseSteps(**steps), LossWeights(), batches, LearningRates(), 0, resume)


@pytest.fixture(scope="module")
def solved():
    torch.set_num_threads(1)
    found, videos = problem()
    optimize.optimize(found, plan(template=80, scene=90, body=40, joint=4))
    return found, videos


@pytest.mark.slow
def test_room_and_ball_are_reconstructed(solved):
    found, _ = solved
    center = torch.tensor([[0.0, 0.0, -0.8], [0.5, 0.5, 0.5]])
    wall = torch.tensor([[ROOM_M, 0.1, 0.1], [0.1, -0.2, ROOM_M]])
    code = torch.full((2,), -1)
    with torch.no_grad():
        assert (found.scene(center, code).signed_distance > 0.05).all(), "the middle of the room is free"
        assert (found.scene(wall, code).signed_distance.abs() < 0.05).all(), "meters; cells are 0.2 m"
    ball = marching_cubes.extract_agent(found.agent, 0.04)
    assert np.abs(np.linalg.norm(ball.vertices, axis=-1) - RADIUS_M).mean() < 0.02


def test_posed_surface_comes_nearer_to_the_truth(solved):
    """Registered roots are off by 4.7 cm; bones and root must correct the error together."""
    found, videos = solved
    motion = results.motions(found, videos, 1.0)["v002"]
    with torch.no_grad():
        posed = found.body.pose(
            found.surface.points, torch.from_numpy(motion.agent_from_bone).float()
        ).numpy()
    center = rigid.apply(motion.world_from_agent, posed).mean(1)
    truth = np.stack([0.03 * np.arange(12), np.zeros(12), np.zeros(12)], axis=-1)
    before = np.linalg.norm(videos[0].world_from_agent[:, :3, 3] - truth, axis=-1).mean()
    assert np.linalg.norm(center - truth, axis=-1).mean() < 0.6 * before


def test_true_distance_field_has_no_loss():
    """The terms of the second phase are consistent, so that distances extend beyond the surface."""
    found, _ = problem()

    class Ball(torch.nn.Module):
        def encode(self, points):
            return points

        def distance(self, points):
            return points.norm(dim=-1) - RADIUS_M

        def color_and_feature(self, points):
            return torch.zeros(len(points), 3), torch.zeros(len(points), 16)

    terms = joint.field_terms(replace(found, agent=Ball()), LossWeights(), torch.Generator().manual_seed(0))
    assert found.surface.distance.max() > 4 * body.REACH * found.surface.length_m
    assert terms["template"][1].mean() < 0.01 and terms["agent eikonal"][1].max() < 0.01


def test_long_gaps_are_interpolated_with_low_confidence(solved):
    problem_, videos = solved
    hidden = torch.tensor([2, 6, 7, 8])
    kept = problem_.agent_frames[~torch.isin(problem_.agent_frames, hidden)]
    motion = results.motions(replace(problem_, agent_frames=kept), videos, certain_gap_s=0.25)["v002"]
    assert np.isfinite(motion.world_from_agent).all() and np.isfinite(motion.agent_from_bone).all()
    assert not motion.agent_visible[hidden].any()
    assert not motion.agent_known[6:9].any() and motion.agent_known[:6].all() and motion.agent_known[9:].all()


def test_posing_is_independent_of_the_batch_size():
    def posed(workers: int) -> torch.Tensor:
        found, _ = problem()
        optimize._pose(found, replace(plan(body=3), workers=workers), list(optimize.split_segments(found, 5)))
        return torch.cat([found.motion.root.flatten(), found.motion.bone.flatten()]).detach()

    one = posed(1)
    assert one.abs().max() > 0.01 and torch.equal(one, posed(2))


def test_uncovered_mask_pixels_attract_the_surface():
    found, _ = problem()
    frame, rays, generator = found.agent_frames[:4], found.store.agent, torch.Generator().manual_seed(0)
    masked = torch.nonzero(rays.label == AGENT)[:, 0]
    rays = rays.at(
        masked[RaysByFrame.of(rays.frame[masked], len(found.video)).pick(frame, 40, generator).flatten()]
    )
    pose = Pose.of(found, frame)

    def bare(shift: torch.Tensor) -> torch.Tensor:
        there = pose.world_from_agent @ rigid_torch.make(torch.eye(3), shift)
        terms = body.surface_terms(
            found,
            replace(pose, world_from_agent=there),
            4000,
            LossWeights(),
            torch.Generator().manual_seed(0),
            rays,
        )
        return terms["uncovered"][1].mean()

    home, shift = torch.tensor([-0.03, 0.03, -0.02]), torch.zeros(3, requires_grad=True)
    assert bare(home) < 0.2 * bare(shift), "registered roots are off by as much"
    bare(shift).backward()
    assert torch.nn.functional.cosine_similarity(-shift.grad, home, dim=0) > 0.7


def beside(found, meters: float) -> dict:
    """Return `surface_terms` of the session with the ball shifted to the right in all pictures."""
    pose = Pose.of(found, torch.arange(4))
    right = (
        pose.world_from_camera
        @ rigid_torch.make(torch.eye(3), torch.tensor([meters, 0, 0]))
        @ rigid_torch.inverse(pose.world_from_camera)
    )
    pose = replace(pose, world_from_agent=right @ pose.world_from_agent)
    return {
        name: term
        for name, (_, term) in body.surface_terms(
            found, pose, 4000, LossWeights(), torch.Generator().manual_seed(0)
        ).items()
    }


def test_padding_of_pictures_is_ignored():
    """Beyond the border of an upright picture the mask distance is extrapolated, also beside a wide
    recording.
    """
    alone, padded = (
        beside(
            problem(videos=[film("v002", 12, True, rng, UPRIGHT), film("v001", 6, False, rng, size)])[0], 0.45
        )["outside"]
        for rng, size in ((np.random.default_rng(0), UPRIGHT), (np.random.default_rng(0), WIDE))
    )
    assert alone.max() > 1 and torch.equal(alone, padded)


def test_surface_behind_a_depth_edge_may_be_occluded():
    found, _ = problem()
    views = found.store.views
    edge = torch.nonzero((views.outside_px[:4] < 0).any(0).any(0)).max() + 1

    def outside(column: slice | int, depth_m: float):
        views.depth[:4, :, column] = depth_m
        for frame in range(4):
            views.occluder[frame] = torch.from_numpy(
                occluder_depth(views.depth[frame].numpy(), views.outside_px[frame].numpy())
            )
        return beside(found, 0.15)["outside"]

    free, hidden = beside(found, 0.15)["outside"], outside(slice(edge, None), 0.3)
    assert len(hidden) < 0.9 * len(free)
    assert torch.equal(outside(edge, 0.0), hidden), "sensors do not measure along edges"


def fused_scene(distance: torch.Tensor) -> Field:
    """Return a scene of 80 cm with these fused distances of grid points in truncation lengths, -1..1."""
    block = torch.cat([distance.expand(9, 9, 9, 1), torch.zeros(9, 9, 9, 4)], dim=-1)
    table, blocks = torch.ones(2, 1, 1, 1, dtype=torch.int32), block.expand(2, -1, -1, -1, -1).half()
    fused = FusedGeometry(torch.full((3,), -0.4), 0.1, 0.2, table, blocks)
    shape = FieldShape((-0.4,) * 3, (0.4,) * 3, (0.4,), videos=1, truncation_m=0.2)
    return Field(shape, free_m=0.1, fused=fused)


def test_penetration_of_the_floor_is_penalized():
    """The floor is 10 cm below the center of the ball; the bottom of the ball is moved up."""
    found, _ = problem()
    height = torch.linspace(-0.4, 0.4, 9).view(1, 9, 1, 1) + 0.1
    found = replace(found, scene=fused_scene((height / 0.2).clamp(-1, 1)))
    pose, shift = Pose.of(found, found.agent_frames[:2]), torch.zeros(3, requires_grad=True)
    pose = replace(pose, world_from_agent=rigid_torch.make(torch.eye(3), shift).expand(2, 4, 4))
    points = found.surface.points[:200].expand(2, -1, -1)
    buried = body.penetration_depth_m(found, pose, points)
    torch.testing.assert_close(buried, (-0.1 - points[..., 1]).clamp(0, 0.2), atol=2e-3, rtol=0)
    buried.mean().backward()
    assert -shift.grad[1] > 10 * shift.grad[[0, 2]].abs().max()


def test_deep_penetration_is_penalized():
    """Fused distances end a little below a surface; a ball half a meter below the floor is moved up too."""
    found, _ = problem()
    found = replace(found, scene=fused_scene(torch.ones(1)))
    pose, shift = Pose.of(found, found.agent_frames[:2]), torch.zeros(3, requires_grad=True)
    pose = replace(
        pose, world_from_agent=rigid_torch.make(torch.eye(3), shift - 0.5 * torch.eye(3)[1]).expand(2, 4, 4)
    )
    points = found.surface.points[:200].expand(2, -1, -1)
    assert not body.penetration_depth_m(found, pose, points).any()
    buried = body.penetration_depth_m(replace(found, floor_m=0.0), pose, points)
    torch.testing.assert_close(buried, 0.5 - points[..., 1])
    buried.mean().backward()
    torch.testing.assert_close(shift.grad, -torch.eye(3)[1])


def test_foot_skate_is_penalized_only_in_slow_contact():
    """A ball rolls at 1 cm and at 1 m per frame, and flies 20 cm above the floor."""
    found, _ = problem()
    floor_m = float(found.surface.sole[:, 1].max())
    found = replace(found, scene=fused_scene(torch.ones(1)), floor_m=floor_m)
    pose, shift = Pose.of(found, found.agent_frames[:3]), torch.tensor([0.0, 0.01, 1.01], requires_grad=True)
    rolling = torch.stack([shift, torch.zeros(3), torch.zeros(3)], dim=-1)

    def foot_skate(place: torch.Tensor) -> torch.Tensor:
        return body.foot_skate(
            found, replace(pose, world_from_agent=rigid_torch.make(torch.eye(3).expand(3, 3, 3), place)), 3
        )

    step_m = torch.tensor([0.01, 1.0])
    expected = step_m.square() / (step_m.square() + (body.STRIDE * found.surface.length_m) ** 2)
    found_there = foot_skate(rolling)
    torch.testing.assert_close(found_there, expected.view(1, 2, 1).expand_as(found_there), atol=1e-3, rtol=0)
    found_there.mean().backward()
    assert shift.grad[0] < 0 < shift.grad[1], "towards each other"
    assert shift.grad[2].abs() < 0.05 * shift.grad[1], "a stride is left alone"
    assert not foot_skate(rolling.detach() + 0.2 * torch.eye(3)[1]).gt(1e-6).any()


def test_bones_are_connected_along_limbs():
    """Two legs are closer to each other than their own bones; each is connected to its own hip."""
    heights = torch.tensor([0.0, -0.1, -0.2])
    side = torch.tensor([-0.02, 0.02])
    center = torch.stack([side[:, None].expand(2, 3), heights.expand(2, 3), torch.zeros(2, 3)], dim=-1).view(
        6, 3
    )
    points = torch.cat(
        [torch.stack([x.expand(60), torch.linspace(0, -0.25, 60), torch.zeros(60)], dim=-1) for x in side]
    )
    across = (points[:, None, 0] * center[:, 0] < 0) & (points[:, None, 1] < -0.05)
    weights = (-torch.cdist(points, center).square() / 0.05**2 - 1e3 * across).softmax(-1)
    joints = Joints.of(points, weights)
    pairs = set(zip(joints.first.tolist(), joints.second.tolist(), strict=True))
    assert {(0, 1), (1, 2), (3, 4), (4, 5), (0, 3)} <= pairs and not pairs & {(1, 4), (1, 5), (2, 4), (2, 5)}
    knee = joints.place[
        [pair == (1, 2) for pair in zip(joints.first.tolist(), joints.second.tolist(), strict=True)]
    ]
    torch.testing.assert_close(knee, torch.tensor([[-0.02, -0.15, 0.0]]), atol=0.01, rtol=0)


def test_fields_survive_saving(solved, tmp_path):
    found, videos = solved
    fields.save(tmp_path, Reconstruction(found.scene, found.agent, found.body, assemble.scene_ids(videos)))
    back = fields.load(tmp_path)
    points = torch.rand(20, 3)
    torch.testing.assert_close(back.agent(points).color, found.agent(points).color.detach())
    torch.testing.assert_close(back.body.weights(points), found.body.weights(points).detach())
    assert back.videos == ("v002",) and back.video_code(None) == -1


@pytest.mark.slow
def test_positional_networks_without_codes_train_and_survive_saving(tmp_path):
    """Baselines of Table 3: positional encoding instead of grids, one scene for all videos."""
    found, videos = problem(replace(SHAPES, encoding="mlp", code_channels=0))
    records = optimize.optimize(found, plan(template=30, scene=30, body=2, joint=2))
    total = records["scene"].total()
    assert np.isfinite(records["joint"].total()).all() and total[-5:].mean() < 0.6 * total[:3].mean()
    assert found.scene.codes is None and not hasattr(found.scene.grid, "levels")
    fields.save(tmp_path, Reconstruction(found.scene, found.agent, found.body, assemble.scene_ids(videos)))
    points = torch.rand(20, 3)
    torch.testing.assert_close(
        fields.load(tmp_path).scene(points).signed_distance, found.scene(points).signed_distance.detach()
    )


def test_volume_marks_free_surface_and_unobserved_space(solved):
    volume = results.feature_volume(solved[0], KDTree(results.measured_points(solved[0])))

    def at(*point: float) -> int:
        return int(
            volume.occupancy[tuple(np.floor((np.array(point) - volume.origin) / results.VOXEL_M).astype(int))]
        )

    assert at(-0.55, 0.35, 0.35) == results.FREE
    surface = volume.occupancy == results.SURFACE
    assert surface.any() and not volume.features[:, ~surface].any()


def test_frames_with_uncertain_cameras_carve_no_free_space(solved):
    found = solved[0]
    points = torch.rand(500, 3) * 2 - 1

    def seen_through(frames: int) -> int:
        rays = found.store.scene.at(torch.nonzero(found.store.scene.frame < frames)[:, 0])
        return int(results.seen_free(replace(found, store=replace(found.store, scene=rays)), points).sum())

    assert 0 == seen_through(0) < seen_through(2) < seen_through(len(found.video))


@pytest.mark.slow
def test_resumed_run_is_bit_identical(tmp_path):
    settings = dict(template=6, scene=8, body=2, joint=6, save_every=3)
    whole, _ = problem()
    optimize.optimize(whole, plan(**settings))

    class KilledError(Exception):
        pass

    broken, _ = problem()
    calls = 0
    original = optimize.JointLoss.__call__

    def dies(self, step, generator):
        nonlocal calls
        calls += 1
        if calls == 5:
            raise KilledError
        return original(self, step, generator)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KilledError):
        patch.setattr(optimize.JointLoss, "__call__", dies)
        optimize.optimize(broken, plan(tmp_path, **settings))
    again, _ = problem()
    optimize.optimize(again, plan(tmp_path, **settings))
    for name, module in whole.modules().items():
        for key, value in module.state_dict().items():
            assert torch.equal(value, again.modules()[name].state_dict()[key]), f"{name}.{key}"
