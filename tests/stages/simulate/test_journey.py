import json

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.longterm import journeys
from pipeline.longterm.config import MotionOptimizationConfig
from pipeline.longterm.motion_synthesis import LongTerm
from pipeline.longterm.short_motions import BodyMotion
from pipeline.longterm.subgoals import Subgoal
from stages.simulate import journey_files, subgoal_file
from tests.pipeline.longterm import strider

SETTINGS = MotionOptimizationConfig(steps=15, vertices=30)


@pytest.fixture(scope="module")
def world():
    dataset = strider.dataset()
    return journeys.LongTermWorld(strider.untrained_model(dataset), dataset.body, dataset.scenes[0])


def read(path, text):
    path.write_text(text)
    return subgoal_file.read(path)


def test_sub_goals_are_read(tmp_path):
    text = "[[subgoal]]\nposition = [1.5, -1]\n[[subgoal]]\nposition = [1, 0.5, 2.0]\nheading_deg = 90\ntime_s = 12\n"
    first, second = read(tmp_path / "goals.toml", text)
    np.testing.assert_array_equal(first.position_world, [1.5, np.nan, -1.0])
    assert first.heading_rad is None and first.time_s is None
    assert second.heading_rad == pytest.approx(np.pi / 2)
    assert second.time_s == 12.0


@pytest.mark.parametrize(
    "text",
    [
        "",
        "seed = 1\n",
        "[[subgoal]]\nposition = [1]\n",
        "[[subgoal]]\nposition = [1, inf]\n",
        "[subgoal]\nposition = [1, 2]\n",
        "subgoal = 3\n",
        "subgoal = [1, 2]\n",
        "[[subgoal]]\nposition = [1, 2]\nheading_deg = nan\n",
        "[[subgoal]]\nposition = [1, 2]\ntime_s = nan\n",
        "[[subgoal]]\nposition = [1, 2]\ntime_s = 1e12\n",
        "[[subgoal]]\nposition = [1, 2]\ntime_s = 5\n[[subgoal]]\nposition = [2, 2]\ntime_s = 4\n",
    ],
)
def test_invalid_sub_goals_are_refused(tmp_path, text):
    with pytest.raises(InputError, match="SIM-002"):
        read(tmp_path / "goals.toml", text)


@pytest.mark.parametrize(
    "line",
    [
        f"position = [{'9' * 400}, 1]",
        f"position = [1, 2]\nheading_deg = {'9' * 400}",
        f"position = [1, 2]\ntime_s = {'9' * 400}",
        "position = " + "[" * 5000 + "]" * 5000,
    ],
)
def test_sub_goals_that_are_no_numbers_are_refused(tmp_path, line):
    with pytest.raises(InputError, match="REC-00[23].*goals.toml"):
        read(tmp_path / "goals.toml", f"[[subgoal]]\n{line}\n")


def test_journey_is_generated_and_written(world, tmp_path, monkeypatch):
    goals = [Subgoal(np.array([-1.2, np.nan, -1.0])), Subgoal(np.array([1.2, np.nan, -1.0]))]
    made = journeys.travel(world, goals, SETTINGS, np.random.default_rng(0))
    again = journeys.travel(world, goals, SETTINGS, np.random.default_rng(0))
    np.testing.assert_array_equal(made.motion.world_from_agent, again.motion.world_from_agent)
    assert made.after.penetration_m <= made.before.penetration_m
    np.testing.assert_allclose(made.subgoals_world[:, [0, 2]], [[-1.2, -1], [1.2, -1]], atol=1e-6)
    assert made.arrival_s[-1] == pytest.approx(made.timestamp_s[-1])
    journey_files.write_journey(tmp_path, made, world.body)
    monkeypatch.setattr(journey_files, "FRAME_SIZE", (48, 64))
    journey_files.write_frames(tmp_path, made.motion[:30], world.body, strider.room(), rate_hz=10.0)
    take = npz.load(tmp_path / "take.npz")
    assert take["agent_from_bone"].shape == (len(made.motion), 5, 4, 4)
    about = json.loads((tmp_path / "take.json").read_text())
    assert about["rate_hz"] == 30 and len(about["subgoals_world"]) == 2 and about["after"]["contact"] <= 1
    assert (tmp_path / "take.glb").read_bytes()[:4] == b"glTF"
    assert len(list((tmp_path / "frames").glob("*.jpg"))) == 10


def test_single_sub_goal_is_refused(world):
    with pytest.raises(InputError, match="SIM-001"):
        journeys.travel(world, [Subgoal(np.zeros(3))], None, np.random.default_rng(0))


@pytest.mark.parametrize("place", [(100.0, np.nan, -1.0), (1.2, 50.0, -1.0), (1.2, -50.0, -1.0)])
def test_sub_goal_outside_the_scene_is_refused(world, place):
    goals = [Subgoal(np.array([-1.2, np.nan, -1.0])), Subgoal(np.array(place))]
    with pytest.raises(InputError, match="SIM-003"):
        journeys.travel(world, goals, None, np.random.default_rng(0))


def test_behavior_take_is_optimized_to_be_physical(world):
    walk = strider.striding(np.array([[1.0, 0, -1.2], [1.0, 0, 1.2]]), 4.0)[::3]
    root = walk.world_from_agent.copy()
    root[:, 1, 3] -= 0.03  # entirely below the floor
    given = BodyMotion(root, walk.agent_from_bone)
    done, before, after = journeys.refine_at_rate(
        world, np.arange(len(root)) / 10, given, MotionOptimizationConfig(steps=60, vertices=30)
    )
    assert after.penetration_m < 0.5 * before.penetration_m
    assert done.world_from_agent.shape == root.shape
    assert np.abs(done.world_from_agent[:, [0, 2], 3] - root[:, [0, 2], 3]).max() < 0.1


def test_recorded_motion_is_optimized_to_be_physical(world, tmp_path):
    walk = strider.striding(np.array([[1.0, 0, -1.2], [1.0, 0, 1.2]]), 2.0)
    root = walk.world_from_agent.copy()
    root[:, 1, 3] -= 0.03
    made = journeys.refine_motion(
        world, BodyMotion(root, walk.agent_from_bone), MotionOptimizationConfig(steps=40, vertices=30)
    )
    assert made.after.penetration_m < 0.5 * made.before.penetration_m
    journey_files.write_journey(tmp_path, made, world.body)
    assert json.loads((tmp_path / "take.json").read_text())["subgoals_world"] == []
    left = journeys.refine_motion(world, walk, None)
    assert left.motion is walk and left.before == left.after


def test_model_of_another_version_is_refused(world, tmp_path):
    world.model.save(tmp_path)
    document = json.loads((tmp_path / "longterm.json").read_text())
    assert LongTerm.load(tmp_path).motion_prior == world.model.motion_prior
    (tmp_path / "longterm.json").write_text(json.dumps({**document, "motion_prior": {"gait_m": 1}}))
    with pytest.raises(InputError, match="ART-007.*(gait_m|clearance_m)"):
        LongTerm.load(tmp_path)
