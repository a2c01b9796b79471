"""Where nobody looked: ways lead round what is solid, through what was not looked at, to where the agent likes to rest."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipeline.models.motion import INFERRED
from pipeline.space import rigid
from stages.reconstruct import hidden, results
from stages.reconstruct.places import places_of
from stages.reconstruct.rays import Views
from stages.reconstruct.route import End, Habits, likeliest
from stages.reconstruct.sightings import Stand, evidence
from tests.stages.reconstruct.test_optimise import problem

ROOT_M = 0.2
WALL_UP_TO_Z = 1.4


class Home:
    """A floor of 2 m by 2 m at height 0, a wall across it with a door at the far end, and a shelf at 0.4 m."""

    shape = SimpleNamespace(low_m=(0.0, -0.1, 0.0), high_m=(2.0, 1.2, 2.0), truncation_m=0.06)
    log_beta = torch.zeros(())

    def distance_at(self, points, video):
        x, y, z = points.double().unbind(-1)
        wall = torch.maximum((x - 1.0).abs() - 0.1, z - WALL_UP_TO_Z)
        shelf = torch.stack([x - 0.5, (y - 0.35).abs() - 0.05, z - 0.5]).amax(0)
        return torch.stack([y, wall, shelf]).amin(0).clamp(-0.06, 0.06)


@pytest.fixture(scope="module")
def places():
    return places_of(Home(), 0.0, np.array([[0.5, ROOT_M, 1.0], [0.25, 0.4 + ROOT_M, 0.25]]))


def habits(*haunts) -> Habits:
    return Habits(1.0, 0.5, 0.2, np.asarray(haunts, float).reshape(-1, 3))


def test_places_are_on_the_floor_and_on_the_shelf_and_not_in_the_wall(places):
    x, y, z = places.position.T
    assert not ((np.abs(x - 1) < 0.1) & (z < WALL_UP_TO_Z)).any()
    on_shelf = y > 0.45
    assert (
        on_shelf.any() and np.allclose(y[on_shelf], 0.4 + ROOT_M, atol=0.03) and (x[on_shelf] < 0.55).all() and (z[on_shelf] < 0.55).all()
    )
    assert np.allclose(y[~on_shelf], ROOT_M, atol=0.03)
    assert (np.abs(x - 1) < 0.05).any(), "there is a door"


def test_the_way_leads_through_the_door_within_time(places):
    start, goal = (places.nearest(np.array([x, ROOT_M, 0.3])) for x in (0.7, 1.3))
    duration = np.full(60, 0.1)
    cell, _ = likeliest(places, habits(), np.zeros((61, len(places.position))), duration, End(start, True), End(goal, True))
    way = places.position[cell]
    assert cell[0] == start and cell[-1] == goal
    assert way[:, 2].max() > WALL_UP_TO_Z - 0.1
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() < 0.35, "a metre a second, and a cell of slack"


def test_it_rests_where_it_likes_to_unless_the_phone_looked_there(places):
    start = places.nearest(np.array([0.7, ROOT_M, 1.0]))
    liked, other = np.array([0.3, ROOT_M, 1.7]), np.array([0.7, ROOT_M, 0.7])
    duration, nothing = np.full(80, 0.1), np.zeros((81, len(places.position)))
    cell, moves = likeliest(places, habits(liked), nothing, duration, End(start, True), End(start, True))
    assert np.linalg.norm(places.position[cell[40]] - liked, axis=-1) < 0.3 and not moves[40]
    looked = nothing - 3.0 * (np.linalg.norm(places.position - liked, axis=1) < 0.6)
    cell, _ = likeliest(places, habits(liked, other), looked, duration, End(start, True), End(start, True))
    assert np.linalg.norm(places.position[cell] - liked, axis=-1).min() > 0.5
    assert np.linalg.norm(places.position[cell[40]] - other, axis=-1) < 0.3


def test_only_what_was_looked_through_speaks_against():
    """The phone looks along z at a wall 3 m away, which is 1 m away on its right half."""
    depth = torch.full((1, 30, 40), 3.0)
    depth[:, :, 20:] = 1.0
    intrinsics = torch.tensor([[[100.0, 0, 80], [0, 100.0, 60], [0, 0, 1]]])
    thumbnails = depth.half(), torch.zeros_like(depth).half(), depth.half()
    views = Views(intrinsics, torch.tensor([[160.0, 120.0]]), *thumbnails, torch.ones(1, dtype=torch.bool))
    stand = Stand.of(0.05 * torch.randn(32, 3, generator=torch.Generator().manual_seed(0)))
    place = np.array([[-0.5, 0, 2.0], [0.5, 0, 2.0], [0.2, 0, 0.6], [-0.5, 0, -2.0], [-5.0, 0, 2.0]])
    cameras = torch.eye(4).expand(1, 4, 4)
    found = evidence(views, np.array([0]), cameras, np.array([1.0]), stand, place)[0]
    assert found[0] < -6 and found[2] < -6, "looked through"
    assert (found[[1, 3, 4]] == 0).all(), "hidden, behind, beside"
    below = np.array([[0.1, -1.0, 0.1]])
    alone, avoided = (evidence(views, np.array([0]), cameras, np.array([1.0]), stand, below, near_m)[0, 0] for near_m in (0.0, 0.3))
    assert alone == 0 and avoided < -6, "where the phone's holder stands"
    assert (evidence(views, np.array([0]), torch.full((1, 4, 4), torch.nan), np.array([1.0]), stand, place) == 0).all()


def test_every_frame_of_a_session_gets_a_pose_and_says_when_it_is_inferred():
    found, videos = problem()
    motion = results.motions(found, videos, 1.0)["v002"]
    seen = np.ones(12, bool)
    seen[:2] = seen[4:10] = False
    root, when = motion.world_from_agent.copy(), motion.timestamp_s * 5
    root[~seen] = np.nan
    motions = {"v002": replace(motion, timestamp_s=when, world_from_agent=root, agent_visible=seen)}
    videos = [replace(video, timestamp_s=when) if video.id == "v002" else video for video in videos]
    motions["v001"] = results.motions(found, videos, 1.0)["v001"]
    filled = hidden.inferred(found, videos, motions, 0.75)
    made = filled["v002"]
    assert np.isfinite(made.world_from_agent).all() and np.isfinite(made.agent_from_bone).all()
    np.testing.assert_array_equal(made.world_from_agent[seen], root[seen])
    assert (made.confidence[~seen] <= INFERRED).all() and (made.confidence[seen] == motion.confidence[seen]).all()
    np.testing.assert_array_equal(made.agent_known, seen)
    crossed = {**motions, "v002": replace(motions["v002"], world_from_agent=motion.world_from_agent)}
    for certain_s, known in ((0.75, seen), (4.0, seen | (np.arange(12) > 2))):
        bridged = hidden.inferred(found, videos, crossed, certain_s)["v002"]
        np.testing.assert_array_equal(bridged.world_from_agent, motion.world_from_agent)
        np.testing.assert_array_equal(bridged.agent_known, known, "crossed by a line, and as little certain where that is long")
    turned = made.world_from_agent[:, :3, :3]
    np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1), np.tile(np.eye(3), (12, 1, 1)), atol=1e-5)
    np.testing.assert_array_equal(filled["v001"].confidence, motions["v001"].confidence)


def test_it_faces_where_it_goes():
    when = np.arange(30) * 0.1
    place = np.stack([0.1 * np.arange(30), np.zeros(30), np.zeros(30)], axis=-1)
    posed = hidden._roots(when, place, np.ones(30, bool), rigid.make(np.eye(3), place[0]), None)
    np.testing.assert_allclose(posed[10:, :3, 2], np.tile([1.0, 0, 0], (20, 1)), atol=1e-3)
    np.testing.assert_allclose(posed[:, :3, 3], place)
