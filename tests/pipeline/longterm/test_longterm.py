from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.baselines import longterm_networks
from pipeline.core.errors import InputError
from pipeline.longterm import simulated_lives
from pipeline.longterm.clip_channels import decode_clip, encode_clips, encode_places
from pipeline.longterm.examples import encode_selection, sample_static_bodies, select_clips
from pipeline.longterm.local_scene import (
    MAX_DISTANCE_M,
    MIN_DISTANCE_M,
    READ_CHANNELS,
    LocalScene,
    read_distances,
)
from pipeline.longterm.motion_synthesis import LongTerm
from pipeline.longterm.networks import GaitPhase, InbetweenNet, PointNet, end_window, gait_progress
from pipeline.longterm.short_motions import STEPS
from pipeline.longterm.subgoals import Subgoal, WalkableFloor, plan_waypoints, sample_visited_subgoals
from tests.pipeline.longterm import strider
from tests.pipeline.longterm.strider import SIZES


@pytest.fixture(scope="module")
def dataset():
    return strider.dataset()


@pytest.fixture(scope="module")
def model(dataset):
    return strider.untrained_model(dataset)


@pytest.fixture(scope="module")
def clips(dataset, model):
    rng = np.random.default_rng(0)
    return encode_selection(dataset, select_clips(dataset, rng, stride=40), model.poses, SIZES.points, rng)


def test_channel_encoding_is_inverted(dataset, model):
    part = dataset.stretches[0][: STEPS + 1]
    p = model.poses.encode(model.poses.channels(part.agent_from_bone))[None]
    coded = encode_clips(
        part.world_from_agent[None], p, np.zeros(1, int), dataset.scenes, 16, np.random.default_rng(0)
    )
    back = decode_clip(coded.channels[0], coded.world_from_clip[0], model.poses)
    np.testing.assert_allclose(back.world_from_agent, part.world_from_agent, atol=1e-5)
    np.testing.assert_allclose(back.agent_from_bone, part.agent_from_bone, atol=3e-3)
    ahead = coded.channels[0, -1, :3] - coded.channels[0, 0, :3]
    assert float(ahead[2]) > 0.3 and abs(float(ahead[0])) < 1e-5


def test_scene_points_are_on_the_surface_near_the_clip(dataset, clips):
    world = torch.einsum(
        "cij,cpj->cpi", torch.from_numpy(clips.world_from_clip[:, :3, :3]).float(), clips.seen.points
    )
    world = world + torch.from_numpy(clips.world_from_clip[:, None, :3, 3]).float()
    open_to_a_body = (world[..., 1] > 0.01) | (
        world[..., [0, 2]].abs().amax(-1) > 0.41
    )  # the block is sunk into the floor
    assert dataset.scenes[0].distance.at(world)[open_to_a_body].abs().max() < 0.06
    assert clips.seen.points.norm(dim=-1).max() < 1.51


def test_distances_along_a_route_are_those_of_the_scene(dataset, clips):
    read = read_distances(clips.seen.field, clips.channels[..., :3])
    assert read.shape == (*clips.channels.shape[:2], READ_CHANNELS)
    frames = torch.from_numpy(clips.world_from_clip).float()
    root = torch.einsum("cij,cfj->cfi", frames[:, :3, :3], clips.channels[..., :3]) + frames[:, None, :3, 3]
    true = dataset.scenes[0].distance.at(root).clamp(MIN_DISTANCE_M, MAX_DISTANCE_M)
    assert (read[..., 0] / 4 - true).abs().max() < 0.05
    torch.testing.assert_close(
        read[..., READ_CHANNELS // 2], 10 * (0.15 - read[..., 0] / 4).clamp_min(0), atol=1e-4, rtol=0
    )


@pytest.mark.parametrize("name", ["ours", *longterm_networks.ABLATIONS])
def test_short_motions_have_the_given_end_points(model, clips, name):
    torch.manual_seed(1)
    made = model if name == "ours" else longterm_networks.build(longterm_networks.ABLATIONS[name], SIZES)
    frames = made.between(clips.channels[:, 0], clips.channels[:, -1], clips.seen)
    assert frames.shape == clips.channels.shape
    torch.testing.assert_close(frames[:, [0, -1]], clips.channels[:, [0, -1]], atol=1e-5, rtol=0)
    assert (frames[:, 30] - clips.channels[:, 30]).abs().max() > 1e-3


def test_stride_encoding_rotates_with_the_path_and_is_inverted(clips):
    torch.manual_seed(3)
    strides, route, p = GaitPhase(SIZES.pose), clips.channels[..., :9], clips.channels[:, 0, 9:]
    carried = strides(p, p, route)
    forward, back = carried.chunk(2, dim=-1)
    torch.testing.assert_close(forward[:, 0], back[:, -1])
    torch.testing.assert_close(
        forward.square().sum(-1), forward[:, :1].square().sum(-1).expand(-1, STEPS + 1), rtol=1e-3, atol=1e-4
    )
    still = strides(p, p, route[:, :1].expand(-1, STEPS + 1, -1))
    torch.testing.assert_close(still, still[:, :1].expand_as(still))
    gone = (route[:, 1:, [0, 2]] - route[:, :-1, [0, 2]]).norm(dim=-1).sum(1)
    torch.testing.assert_close(gait_progress(route)[:, -1, 0], gone)


def test_scene_code_is_read_in_every_frame(clips):
    torch.manual_seed(0)
    net, features = InbetweenNet(9, 0, SIZES, with_scene=True), []
    net.lstm.register_forward_hook(lambda _, __, made: features.append(made[0]))
    start, end = clips.channels[:, 0, :9], clips.channels[:, -1, :9]
    made = net(start, end, clips.seen.points)
    line = torch.lerp(start[:, None], end[:, None], torch.linspace(0, 1, STEPS + 1)[:, None])
    code = net.point_net(clips.seen.points)[:, None].expand(-1, STEPS + 1, -1)
    offset = net.out(torch.cat([features[0], code], dim=-1))
    torch.testing.assert_close(made, line + end_window(line) * offset)
    nothing = net(start, end, 0 * clips.seen.points)
    assert (made - nothing)[:, 1:-1].abs().amax(-1).min() > 0


def test_scene_changes_only_networks_with_scene_input(clips):
    torch.manual_seed(2)
    moved = LocalScene(clips.seen.points + 0.5, clips.seen.field - 0.3)
    for name, differs in (
        ("ours_no_scene", False),
        ("route_tr_pose", True),
        ("base", True),
        ("base_no_scene", False),
    ):
        net = longterm_networks.build(longterm_networks.ABLATIONS[name], SIZES)
        pair = [
            net.between(clips.channels[:, 0], clips.channels[:, -1], seen) for seen in (clips.seen, moved)
        ]
        assert (not torch.equal(*pair)) == differs, name
    assert not any(isinstance(p, torch.nn.Parameter) for p in PointNet(4, with_scene=False).parameters())


def test_model_survives_saving(model, clips, tmp_path):
    model.save(tmp_path)
    again = LongTerm.load(tmp_path)
    args = (clips.channels[:, 0], clips.channels[:, -1], clips.seen)
    torch.testing.assert_close(again.between(*args), model.between(*args))
    torch.testing.assert_close(again.poses.basis, model.poses.basis)
    assert again.motion_prior == model.motion_prior
    np.testing.assert_array_equal(again.contacts.foot, model.contacts.foot)


def test_motion_prior_is_that_of_the_data(dataset, model):
    assert model.motion_prior.clearance_m == pytest.approx(strider.HIP_M, abs=0.01)
    ends = [
        np.linalg.norm(s.world_from_agent[60, :3, 3] - s.world_from_agent[0, :3, 3])
        for s in dataset.stretches
    ]
    assert min(ends) - 0.05 < model.motion_prior.pace_m < max(ends) + 0.05


def test_moving_clips_are_kept_and_waypoints_are_level(dataset, model, monkeypatch):
    rng = np.random.default_rng(0)
    cuts = select_clips(dataset, rng, stride=10, resting=0.0)
    ways = [
        np.linalg.norm((p.world_from_agent[-1] - p.world_from_agent[0])[:3, 3]) for p in cuts.parts(dataset)
    ]
    assert min(ways) > 0.5
    most = len(ways) - 1
    fewer = select_clips(dataset, np.random.default_rng(0), stride=10, resting=0.0, most=most)
    assert len(fewer.start) == most, "clips are not halved for one too many"
    monkeypatch.setattr("pipeline.longterm.examples.LEVEL_SHARE", 1.0)
    stills = sample_static_bodies(dataset, model.poses, SIZES.points, rng, most=50)
    assert len(stills.scene) <= 60
    torch.testing.assert_close(
        stills.places.place[:, 1:],
        torch.tensor([1.0, 0, 0, 0, 1, 0]).expand(len(stills.scene), -1),
        atol=1e-5,
        rtol=0,
    )
    assert float(stills.truth[:, 1].std()) == pytest.approx(0.03, rel=0.4)


def test_waypoints_have_clearance(dataset):
    root = np.tile(np.eye(4), (2, 1, 1))
    root[:, :3, 3] = [[1.2, 0.3, 1.2], [0.0, 0.7, 0.0]]  # over the floor, over the block
    encoded = encode_places(root, np.array([0, 0]), dataset.scenes, 16, np.random.default_rng(0))
    torch.testing.assert_close(encoded.place[:, 0], torch.tensor([0.3, 0.2]), atol=0.03, rtol=0)


def test_planned_legs_avoid_the_block_and_keep_the_duration(dataset, model):
    ends = [
        Subgoal(np.array([-1.2, np.nan, 0.0]), 0.0),
        Subgoal(np.array([1.2, np.nan, 0.0]), np.pi, 20.0),
        Subgoal(np.array([0.0, 0.7, 0.0])),
    ]
    places = plan_waypoints(ends, dataset.scenes[0], model.motion_prior)
    where = places.world_from_agent[:, :3, 3]
    np.testing.assert_allclose(
        where[places.subgoal], [[-1.2, strider.HIP_M, 0], [1.2, strider.HIP_M, 0], [0, 0.7, 0]], atol=0.01
    )
    assert places.subgoal[1] == 10  # 20 s are ten legs; the remaining time is rest
    on_floor = np.abs(where[:, 1] - strider.HIP_M) < 0.05
    assert (np.abs(where[on_floor][:, [0, 2]]).max(1) > 0.4).all()
    np.testing.assert_allclose(places.world_from_agent[places.subgoal[1], :3, 2], [0, 0, -1], atol=1e-9)
    assert np.linalg.norm(np.diff(where[:, [0, 2]], axis=0), axis=1).max() <= 1.36 * model.motion_prior.pace_m
    floor = WalkableFloor.of(dataset.scenes[0], model.motion_prior)
    assert not floor.free[tuple(np.round((np.array([0.0, 0.0]) - floor.corner) / 0.08).astype(int))]


def test_sub_goals_near_the_block_are_moved_to_free_space_and_legs_pass_it(dataset, model):
    floor = WalkableFloor.of(dataset.scenes[0], model.motion_prior)
    read_distances, inside, far = (np.array([x, strider.HIP_M, 0.1]) for x in (0.5, 0.0, 1.2))
    for position in (read_distances, inside):
        moved = floor.nearest_turning_place(position)
        assert 0.55 < np.abs(moved[[0, 2]]).max() < 0.9
    np.testing.assert_array_equal(floor.nearest_turning_place(far), far)
    root_m = floor.height_m + model.motion_prior.clearance_m
    landed = floor.landing(np.array([0.1, 0.7, 0.0]), root_m)
    assert (
        np.abs(landed[[0, 2]]).max()
        > np.abs(floor.nearest_turning_place(np.array([0.1, root_m, 0.0]))[[0, 2]]).max()
    ), "a leap needs more room"
    places = plan_waypoints(
        [Subgoal(np.array([-0.75, np.nan, 0.0])), Subgoal(np.array([0.75, np.nan, 0.0]))],
        dataset.scenes[0],
        model.motion_prior,
    )
    assert floor.blocked_m(places.world_from_agent[[0, -1], :3, 3]) > 0.7
    assert floor.blocked_m(places.world_from_agent[:, :3, 3]) < 0.1


def test_waypoint_in_an_enclosure_is_moved_out(dataset, model):
    fence = [
        strider.box(*sides)
        for sides in (([-2, -0.1, 0.7], [-0.6, 0.5, 0.8]), ([-0.7, -0.1, 0.7], [-0.6, 0.5, 2]))
    ]
    floor = WalkableFloor.of(
        replace(dataset.scenes[0], mesh=strider.merged(strider.room(), *fence)), model.motion_prior
    )
    moved = floor.nearest_turning_place(np.array([-1.2, strider.HIP_M, 1.3]))
    assert moved[0] > -0.6 or moved[2] < 0.7


def test_scene_without_free_floor_is_refused():
    nowhere = WalkableFloor(np.zeros((3, 3), bool), np.zeros((3, 3)), np.zeros(2), 0.0, 0.0, 1.0)
    with pytest.raises(InputError, match="SIM-003"):
        nowhere.landing(np.zeros(3), 0.2)


def test_resting_body_turns_around_in_two_legs(dataset, model):
    goals = [
        Subgoal(np.array([x, np.nan, 1.2]), time_s=t) for x, t in ((-1.0, None), (1.0, 20.0), (-1.0, None))
    ]
    ahead = plan_waypoints(goals, dataset.scenes[0], model.motion_prior).world_from_agent[:, :3, 2]
    assert np.degrees(np.arccos(np.clip((ahead[1:] * ahead[:-1]).sum(1), -1, 1))).max() < 100


def test_preferred_places_are_recorded_places():
    been = np.concatenate([np.tile([1.0, 0.2, 1.0], (300, 1)), np.tile([-1.0, 0.4, 0.5], (100, 1))])
    drawn = np.array(
        [goal.position_world for goal in sample_visited_subgoals(been, 200, np.random.default_rng(0))]
    )
    assert set(map(tuple, np.round(drawn, 6))) == {(1.0, 0.2, 1.0), (-1.0, 0.4, 0.5)}
    assert (np.abs(np.diff(drawn[:, 0])) > 1).all()  # adjacent ones are separated


def test_sub_goals_are_placed_on_furniture_and_floor(dataset, model):
    """The block of the room is 0.5 m high."""
    goals = [Subgoal(np.array(place)) for place in ([-1.2, np.nan, 0.0], [0.0, 0.45, 0.0], [1.2, 0.9, 0.0])]
    where = plan_waypoints(goals, dataset.scenes[0], model.motion_prior)
    top, floor = where.world_from_agent[where.subgoal[1:], :3, 3]
    assert top[1] == pytest.approx(0.5 + strider.HIP_M, abs=0.04)
    np.testing.assert_allclose(floor, [1.2, strider.HIP_M, 0.0], atol=0.01)


def test_long_motion_passes_its_waypoints(dataset, model):
    places = plan_waypoints(
        [Subgoal(np.array([-1.2, np.nan, -1.0])), Subgoal(np.array([1.2, np.nan, 1.0]))],
        dataset.scenes[0],
        model.motion_prior,
    )
    moving, met = model.long_motion(
        places.world_from_agent, dataset.body, dataset.scenes[0], np.random.default_rng(0)
    )
    assert len(moving) == STEPS * (len(places.world_from_agent) - 1) + 1
    np.testing.assert_allclose(moving.world_from_agent[::STEPS], met.world_from_agent, atol=1e-4)
    np.testing.assert_allclose(np.linalg.det(moving.world_from_agent[:, :3, :3]), 1, atol=1e-4)


def test_bodies_of_passed_waypoints_are_generated_and_others_kept(dataset, model):
    ends = [
        Subgoal(np.array([-1.2, np.nan, -1.0])),
        Subgoal(np.array([1.2, np.nan, -1.0]), time_s=30.0),
        Subgoal(np.array([1.2, np.nan, 1.0])),
    ]
    places = plan_waypoints(ends, dataset.scenes[0], model.motion_prior)
    given, drawn = (
        model.long_motion(
            places.world_from_agent, dataset.body, dataset.scenes[0], np.random.default_rng(0), stops=stops
        )
        for stops in (places.subgoal, None)
    )
    changed = (given[1].agent_from_bone != drawn[1].agent_from_bone).any((1, 2, 3))
    assert not changed[places.subgoal].any() and changed.any()
    rest = given[1].agent_from_bone[2 : places.subgoal[1]]  # at the last of these it turns to leave
    np.testing.assert_array_equal(rest, np.broadcast_to(rest[:1], rest.shape))
    assert len(given[0]) == len(drawn[0])


def test_simulated_clips_survive_saving(dataset, tmp_path):
    simulated_lives.save(
        tmp_path,
        dataset.body,
        [strider.room()],
        dataset.stretches,
        dataset.scene_of,
        ["train", "held_out", "unseen"],
    )
    again = simulated_lives.load(tmp_path)
    assert len(again.train.stretches) == 1 and again.kinds == ("held_out", "unseen")
    last = again.held_out.stretches[1]
    np.testing.assert_allclose(last.agent_from_bone, dataset.stretches[2].agent_from_bone, atol=1e-6)
    assert again.train.scenes[0].floor_m == pytest.approx(0.0, abs=0.01)
    assert dataset.subset([2]).scene_of == (0,)
