"""Environments: checks of the libraries, seeding, collision of persons with walls, and batching."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.behavior.perception import FeatureVolume
from pipeline.core.errors import InputError
from pipeline.environments import NAME
from pipeline.environments.floor import PersonFloor, to_local, to_world
from pipeline.environments.rewards import REWARDS, StepOutcome
from pipeline.environments.world import AnimalWorld
from tests.pipeline.behavior.wandering import wandering
from tests.pipeline.environments.small_world import QUICK, small_world, write_build
from tests.pipeline.environments.test_other_home import write

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("pettingzoo")


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    """Build with an untrained model in a room of 4 m."""
    return write_build(tmp_path_factory.mktemp("build"))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("embodiment", ["person", "robot"])
def test_gymnasium_checker_passes(build, embodiment):
    from gymnasium.utils.env_checker import check_env

    how = {"config": QUICK, "embodiment": embodiment, "episode_s": 3.0}
    env = gymnasium.make(NAME, build=str(build), **how)
    check_env(env.unwrapped)


@pytest.mark.parametrize(
    "lines",
    [
        'import gymnasium; gymnasium.make("pipeline.environments:AgentToSim/Cat-v0", build="missing")',
        'import gymnasium, pipeline.environments; gymnasium.make("AgentToSim/Cat-v0", build="missing")',
        'import gymnasium; gymnasium.make_vec("pipeline.environments:AgentToSim/Cat-v0", build="missing")',
    ],
)
def test_gymnasium_finds_the_environment_in_a_new_process(lines):
    done = subprocess.run([sys.executable, "-c", lines], capture_output=True, text=True)
    assert "InputError: ART-003 missing" in done.stderr, "the environment is found, the build is not"


@pytest.mark.filterwarnings("error")
def test_pettingzoo_checks_pass():
    from pettingzoo.test import parallel_api_test, parallel_seed_test

    from pipeline.environments.parallel_env import PersonAnimalEnv

    world = small_world()
    parallel_api_test(PersonAnimalEnv(world), num_cycles=60)
    parallel_seed_test(lambda: PersonAnimalEnv(AnimalWorld(world.residents, QUICK)), num_cycles=40)


def test_steps_and_pictures_before_reset_raise_the_error_of_gymnasium():
    from pipeline.environments.parallel_env import PersonAnimalEnv
    from pipeline.environments.person_env import PersonEnv
    from pipeline.environments.vector_env import PersonVectorEnv

    world = small_world()
    env, many, both = (
        PersonEnv(world, render_mode="rgb_array"),
        PersonVectorEnv(world, 2),
        PersonAnimalEnv(world),
    )
    both.render_mode = "rgb_array"
    too_early = [env.render, lambda: env.step(np.zeros(3)), lambda: many.step(np.zeros((2, 3)))]
    for call in (*too_early, both.render, lambda: both.step({"person": np.zeros(3)})):
        with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
            call()
    for each in (env, both):
        each.reset(seed=0)
        assert each.render().shape == (400, 400, 3)


def test_vectorized_episodes_restart_and_are_seeded(build):
    lives = []
    for _ in range(2):
        env = gymnasium.make_vec(NAME, num_envs=4, build=str(build), config=QUICK, episode_s=1.0)
        seen, _ = env.reset(seed=3)
        ends = np.zeros(4, int)
        for _ in range(25):
            seen, reward, terminated, truncated, info = env.step(np.zeros((4, 3), np.float32))
            place = np.linalg.norm(seen["animal"][:, :2], axis=1)
            np.testing.assert_allclose(info["distance_m"], place, rtol=1e-5)
            ends += terminated | truncated
        assert seen["animal"].shape == (4, 7) and (ends >= 2).all() and np.isfinite(reward).all()
        lives.append(seen["animal"])
    np.testing.assert_array_equal(*lives)


def test_animal_can_live_in_another_home(build, tmp_path):
    own, other = write(tmp_path / "own"), write(tmp_path / "other")
    shutil.copytree(build / "behavior", own / "behavior")
    wandering().save(own / "behavior_data")
    env = gymnasium.make(NAME, build=str(own), home=str(other), config=QUICK)
    _, info = env.reset(seed=0, options={"split": "test"})
    assert info["share_known"] == 1.0 and info["home"] == 0, "the same room"
    single = gymnasium.make(NAME, build=str(own), homes=str(other), config=QUICK)
    assert single.unwrapped.world.floors[0].floor_m == env.unwrapped.world.floors[0].floor_m
    for _ in range(15):
        seen, *_ = env.step(env.action_space.sample())
    assert env.observation_space.contains(seen)
    with pytest.raises(InputError, match="ART-003.*nowhere"):
        gymnasium.make(NAME, build=str(own), home="nowhere", config=QUICK)


@pytest.mark.parametrize(
    "settings",
    [
        {"embodiment": "car"},
        {"reward": "x"},
        {"observations": "rgbd"},
        {"episode_s": "long"},
        {"sped_m_s": 1.0},
        {"start_m": (float("nan"), 1.0)},
    ],
)
def test_invalid_settings_are_refused(build, settings):
    with pytest.raises(InputError, match="REC-00[12]"):
        AnimalWorld.opened(build, **settings)


def test_opening_a_build_leaves_the_random_state_of_the_program(build):
    states = torch.random.get_rng_state(), np.random.get_state()[1], torch.get_num_threads()
    AnimalWorld.load(build, QUICK).begin(1, np.random.default_rng(0))
    assert torch.equal(torch.random.get_rng_state(), states[0])
    np.testing.assert_array_equal(np.random.get_state()[1], states[1])
    assert torch.get_num_threads() == states[2]


FORKED = """
import multiprocessing, sys, gymnasium, numpy as np, torch
torch.set_num_threads(2)
torch.ones(400_000).exp().sum()
how = {"build": sys.argv[1], "sequence_steps": 2, "candidates": 1, "vectorization_mode": "async"}
how |= {"id": "pipeline.environments:AgentToSim/Cat-v0", "vector_kwargs": {"context": "fork"}}
envs = gymnasium.make_vec(num_envs=2, **how)
envs.reset(seed=0)
envs.step(np.zeros((2, 3), np.float32))
envs.close()
many = gymnasium.make_vec(num_envs=2, **{name: how[name] for name in ("id", "build", "sequence_steps", "candidates")})
many.reset(seed=0)
child = multiprocessing.get_context("fork").Process(target=many.reset)
child.start()
child.join()
assert child.exitcode == 0
assert torch.get_num_threads() == 2, "the setting of the program"
"""


def test_forked_environments_do_not_hang_in_threads_of_pytorch(build):
    running = subprocess.Popen([sys.executable, "-c", FORKED, str(build)], start_new_session=True)
    try:
        assert running.wait(120) == 0
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(running.pid, signal.SIGKILL)


def test_start_distances_may_be_given_in_any_order():
    starts = []
    for order in ((0.8, 1.5), (1.5, 0.8)):
        world = small_world(replace(QUICK, start_m=order))
        world.begin(9, np.random.default_rng(0))
        starts.append(world.distance_m)
    np.testing.assert_array_equal(*starts)
    assert (starts[0] > 0.7).all() and (starts[0] < 1.6).all()


def test_an_unknown_split_is_refused():
    from pipeline.environments.person_env import PersonEnv

    animals = small_world().residents
    env, untouched = (PersonEnv(AnimalWorld(animals, QUICK)) for _ in range(2))
    for split in ("valid", ["test"]):
        with pytest.raises(InputError, match="REC-002"):
            env.reset(seed=0, options={"split": split})
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(np.zeros(3))
    for each in (env, untouched):
        each.reset(seed=0)
    with pytest.raises(InputError, match="REC-002.*'valid'"):
        env.reset(options={"split": "valid"})
    went_on = [each.step(np.ones(3))[0]["animal"] for each in (env, untouched)]
    np.testing.assert_array_equal(*went_on)


def test_a_person_begins_at_the_nearest_free_place_where_none_is_drawn():
    world = small_world(replace(QUICK, start_m=(40.0, 50.0)))
    world.begin(3, np.random.default_rng(0))
    assert not world.floors[0].blocks(world.persons.position).any()


def test_fast_persons_stay_in_front_of_thin_walls():
    world = small_world(replace(QUICK, speed_m_s=12.0))
    world.begin(30, np.random.default_rng(0))
    for _ in range(5):
        world.step(np.tile([1.0, 0.0, 0.1], (30, 1)))
    assert (np.abs(world.persons.position) < 2.0).all(), "the walls begin at 2 m"


def test_an_unknown_render_mode_is_refused():
    from pipeline.environments.parallel_env import PersonAnimalEnv
    from pipeline.environments.person_env import PersonEnv

    for environment in (PersonEnv, PersonAnimalEnv):
        with pytest.raises(InputError, match="REC-002.*'foo'"):
            environment(small_world(), render_mode="foo")


@pytest.mark.parametrize(
    "actions", [["ahead"] * 4, np.zeros((3, 3)), np.full((4, 3), "1,0"), [[0.0] * 3, [0.0]], [None] * 4]
)
def test_unusable_actions_of_many_are_refused(actions):
    from pipeline.environments.vector_env import PersonVectorEnv

    env = PersonVectorEnv(small_world(), 4)
    env.reset(seed=0)
    with pytest.raises(InputError, match="SIM-012"):
        env.step(actions)


@pytest.mark.parametrize(
    "action",
    [[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [0.0, 0.0], "ahead", [0, 0, [1]], {"turn": 1}, [1j] * 3],
)
def test_nonfinite_actions_are_refused(action):
    from pipeline.environments.person_env import PersonEnv

    env = PersonEnv(small_world())
    env.reset(seed=0)
    with pytest.raises(InputError, match="SIM-012"):
        env.step(action)


def test_nonfinite_goals_are_refused():
    from pipeline.environments.parallel_env import PersonAnimalEnv

    env = PersonAnimalEnv(small_world())
    env.reset(seed=0)
    with pytest.raises(InputError, match="SIM-012"):
        env.step({"person": np.zeros(3), "animal": np.array([np.nan, 0.0])})
    with pytest.raises(InputError, match="SIM-012"):
        env.step({"animal": np.zeros(2)})


def test_plans_are_followed_for_several_steps():
    world = small_world()
    world.begin(3, np.random.default_rng(0))
    for _ in range(40):
        world.step(np.zeros((3, 3)))
    assert world.plans_per_step < 0.1


def test_persons_follow_actions_and_stay_out_of_walls():
    world = small_world()
    world.begin(2, np.random.default_rng(0))
    world.persons.position[:], world.persons.heading[:] = 0.0, [0.0, np.pi / 2]
    world.step(np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(world.persons.position, [[0, 0.12], [0.12, 0]], atol=1e-9)
    for _ in range(60):
        world.step(np.array([[1.0, 0.0, 0.0], [1.0, 0.3, 0.0]]))
    assert (np.abs(world.persons.position) < 2.0).all(), "the walls begin at 2 m"
    assert np.abs(world.persons.position).max(1).min() > 1.7


def test_persons_stay_out_of_unobserved_space():
    """The grid around the thin walls of the room is unobserved."""
    occupancy = np.full((44, 20, 44), 2, np.uint8)
    occupancy[10:34, :, 10:34] = 1
    occupancy[11:33, 2:, 11:33] = 0
    volume = FeatureVolume(
        np.zeros((1, *occupancy.shape), np.float16), occupancy, np.array([-2.2, -0.2, -2.2]), 0.1
    )
    floor = PersonFloor.of(volume, np.array([[0.0, 0.2, 0.0]]))
    assert not floor.blocked[11:33, 11:33].any() and floor.blocked.sum() == 44**2 - 22**2
    world = small_world()
    world.floors[0] = floor
    world.begin(40, np.random.default_rng(0))
    assert (np.abs(world.persons.position) < 1.1).all(), "meters: inside"
    for _ in range(30):
        world.step(np.tile([1.0, 0.0, 0.1], (40, 1)))
        assert (np.abs(world.persons.position) < 1.1).all()


def test_local_and_world_frames_are_inverse():
    np.testing.assert_allclose(to_world(np.array([0.0, 1.0]), np.array(np.pi / 2)), [1, 0], atol=1e-9)
    np.testing.assert_allclose(to_world(np.array([1.0, 0.0]), np.array(0.0)), [1, 0], atol=1e-9)
    point = np.array([0.3, -0.7])
    np.testing.assert_allclose(to_local(to_world(point, np.array(0.4)), np.array(0.4)), point)


def test_animal_goes_to_a_commanded_goal():
    world = small_world()
    world.begin(1, np.random.default_rng(0))
    goal = world.animal_position + np.array([[0.5, 0.0, 0.0]])
    world.animals.command(goal)
    for _ in range(12):
        world.step(np.zeros((1, 3)))
    np.testing.assert_allclose(world.animals.goal[0, [0, 2]], goal[0, [0, 2]], atol=1e-5)


@pytest.mark.parametrize(("speed_m_s", "flees"), [(0.4, False), (1.0, True), (-1.0, False)])
def test_only_who_gets_away_fast_flees(speed_m_s, flees):
    """At 0.4 m/s, a walk, an animal is 0.8 m further away after 2 s."""
    world = small_world()
    world.begin(1, np.random.default_rng(0))
    world.persons.position = world.animal_position[:, [0, 2]] - [[0.0, 1.6]]
    plan = world.animals.plan.root[0, :, :3, 3]
    plan[:] = world.animal_position[0]
    plan[:, 2] += speed_m_s * 0.1 * np.arange(1, len(plan) + 1)
    assert world.fleeing.tolist() == [flees]
    world.persons.position = world.animal_position[:, [0, 2]] - [[0.0, 2.5]]
    assert not world.fleeing.any(), "nobody is near"


def test_rewards_have_their_documented_values():
    near = StepOutcome(
        np.array([1.0, 1.0]), np.array([0.6, 0.9]), np.array([0.0, 0.5]), np.array([False, True])
    )
    assert REWARDS["approach"](near).tolist() == pytest.approx([5.4, -4.9])
    assert REWARDS["follow"](near).tolist() == pytest.approx([-0.6, -0.3])
    assert REWARDS["calm"](near).tolist() == [0.0, -0.5]


def test_builds_of_one_animal_live_as_before_homes_of_several():
    torch.manual_seed(0)
    world = small_world()
    world.begin(2, np.random.default_rng(4))
    for step in range(30):
        world.step(np.full((2, 3), 0.2))
        if step == 14:
            world.restart(np.array([1]))
    found = np.concatenate([world.animal_position, world.persons.position], axis=1)
    expected = [[1.2843, 0.1989, -0.3307, 1.9933, -1.7186], [-0.4235, 0.2024, 0.4119, 0.0628, 1.0658]]
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert world.names == ("animal",) and world.animals.companions is None


def test_folder_without_model_is_refused(tmp_path):
    with pytest.raises(InputError, match="ART-003"):
        AnimalWorld.load(tmp_path, QUICK)
