"""Environments in a home of a cat and a dog."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.environments.floor import to_world
from pipeline.environments.rendering import ANIMAL, OTHER, bird_view
from pipeline.environments.rgbd import RgbdCamera
from pipeline.environments.world import AnimalWorld
from pipeline.geometry import rigid
from pipeline.longterm.bodies import SkinnedBody
from tests.pipeline.behavior.wandering import BONES, REST
from tests.pipeline.environments.home_of_two import write_animals
from tests.pipeline.environments.small_world import QUICK
from tests.pipeline.environments.test_homes_and_rgbd import BLUE, RED, box

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("pettingzoo")


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build of a home of two."""
    folder = tmp_path_factory.mktemp("builds") / "pair"
    write_animals(folder / "animals")
    return folder


@pytest.fixture
def three(pair, tmp_path):
    """The same home with a bird that has no model."""
    shutil.copytree(pair, tmp_path / "three")
    (tmp_path / "three/animals/bird/behavior_data").mkdir(parents=True)
    return tmp_path / "three"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("animal", [None, "dog"])
def test_gymnasium_checker_passes(pair, animal):
    from gymnasium.utils.env_checker import check_env

    import pipeline.environments  # noqa: F401

    how = {"config": QUICK, "episode_s": 3.0, "animal": animal}
    env = gymnasium.make("AgentToSim/Cat-v0", build=str(pair), **how)
    check_env(env.unwrapped)
    seen, _ = env.reset(seed=0)
    assert seen["others"].shape == (1, 8) and env.unwrapped.world.target == (animal or "cat")


@pytest.mark.filterwarnings("error")
def test_pettingzoo_checks_pass(pair):
    from pettingzoo.test import parallel_api_test, parallel_seed_test

    from pipeline.environments.parallel_env import PersonAnimalEnv

    world = AnimalWorld.load(pair, QUICK)
    parallel_api_test(PersonAnimalEnv(world), num_cycles=60)
    parallel_seed_test(lambda: PersonAnimalEnv(AnimalWorld(world.residents, QUICK)), num_cycles=40)


def test_each_animal_is_an_agent_that_may_be_steered(pair):
    from pipeline.environments.parallel_env import PersonAnimalEnv

    env = PersonAnimalEnv(pair, config=QUICK, animal="dog", reward="follow")
    seen, _ = env.reset(seed=0)
    assert env.agents == ["person", "cat", "dog"]
    for _ in range(12):
        steered = {"person": np.zeros(3), "cat": np.array([0.1, 0.0])}
        seen, rewards, *_, infos = env.step(steered)
    assert rewards["dog"] == -rewards["person"] != 0 and rewards["cat"] == 0.0
    cat, dog = (env.world.batches[name] for name in ("cat", "dog"))
    assert np.isfinite(cat.goal_command).all() and np.isnan(dog.goal_command).all()
    root = cat.past[-1].root[0, 0]
    ahead = rigid.inverse(root)[:3, :3] @ (dog.past[-1].root[0, 0, :3, 3] - root[:3, 3])
    assert seen["cat"].shape == (12,) and seen["cat"][4] == 1.0
    np.testing.assert_allclose(seen["cat"][5:7], ahead[[0, 2]], atol=0.02)  # meters: it leans a little
    assert infos["cat"]["distance_m"] == pytest.approx(np.hypot(*seen["cat"][:2]), abs=1e-5)
    env.step({"person": np.zeros(3), "cat": None})
    assert np.isnan(cat.goal_command).all(), "it chooses its own goal again"


def test_animals_of_a_life_perceive_each_other_and_nobody_else(pair):
    both = AnimalWorld.load(pair, QUICK)
    alone = AnimalWorld({"cat": both.residents["cat"], "dog": None}, QUICK)
    tracks = []
    for world in (both, alone):
        world.begin(3, np.random.default_rng(1))
        start = world.animal_position.copy()
        for _ in range(30):
            world.step(np.zeros((3, 3)))
        tracks.append((start, world.animal_position.copy()))
    np.testing.assert_array_equal(tracks[0][0], tracks[1][0])
    assert np.abs(tracks[0][1] - tracks[1][1]).max() > 1e-3, "meters"
    for name, other in (("cat", "dog"), ("dog", "cat")):
        past = both.batches[other].past_world
        np.testing.assert_allclose(both.batches[name].companions[:, 0, 1:, :3], past[:, :-1])


def test_animals_begin_apart_and_restart_together(pair):
    world = AnimalWorld.load(pair, QUICK)
    world.begin(20, np.random.default_rng(0))
    cat, dog = world.batches.values()
    gap = np.linalg.norm((cat.past_world - dog.past_world)[:, -1, [0, 2]], axis=-1)
    assert gap.min() >= dog.clearance_m, "bodies do not overlap"
    from_dog = world.distance_of_m("dog")
    assert (from_dog >= dog.clearance_m).mean() > 0.9, "persons seldom find no place"
    world.step(np.zeros((20, 3)))
    before = [batch.past_world.copy() for batch in (cat, dog)]
    world.restart(np.array([4, 7]))
    kept = np.setdiff1d(np.arange(20), [4, 7])
    for old, batch, other in zip(before, (cat, dog), (dog, cat), strict=True):
        np.testing.assert_array_equal(batch.past_world[kept], old[kept])
        assert np.abs(batch.past_world[[4, 7]] - old[[4, 7]]).max() > 1e-2
        np.testing.assert_allclose(batch.planned_others[[4, 7], 1], other.past_world[[4, 7], -1])
    world.step(np.zeros((20, 3)))


def test_vectorized_lives_are_seeded_and_others_are_where_they_are(pair):
    import pipeline.environments  # noqa: F401

    lives = []
    for _ in range(2):
        env = gymnasium.make_vec(
            "AgentToSim/Cat-v0", num_envs=4, build=str(pair), config=QUICK, episode_s=1.0
        )
        env.reset(seed=3, options={"split": "test"})
        for _ in range(25):
            seen, *_ = env.step(np.full((4, 3), 0.2, np.float32))
        assert env.observation_space.contains(seen)
        lives.append(seen["others"])
    np.testing.assert_array_equal(*lives)
    persons, dog = env.world.persons, env.world.batches["dog"].past_world[:, -1]
    place = persons.position + to_world(seen["others"][:, 0, 1:3], persons.heading)
    np.testing.assert_allclose(place, dog[:, [0, 2]], atol=1e-5)


def test_both_animals_are_drawn(pair):
    world = AnimalWorld.load(pair, QUICK)
    world.begin(1, np.random.default_rng(0))
    picture = bird_view(world, 0)
    assert all((picture == color).all(-1).sum() > 20 for color in (ANIMAL, OTHER))


def test_camera_sees_all_animals():
    bodies = [
        SkinnedBody(box((0.2, 0.2, 0.2), color), np.full((8, BONES), 1 / BONES), REST, np.zeros(0))
        for color in (RED, (30, 200, 30))
    ]
    camera = RgbdCamera([box((20, 20, 1.0), BLUE, (0, 0, 2.1))], bodies)
    places = [rigid.make(np.eye(3), np.array([x, -0.4, 1.0])) for x in (-0.3, 0.3)]
    rgb, depth_m = camera.picture(0, np.zeros(3), 0.0, [(place, REST) for place in places])
    for color in (RED, (30, 200, 30)):
        seen = (rgb == color).all(-1)
        assert seen.sum() > 10 and 0.8 < depth_m[seen].mean() < 1.2, "meters"


def test_actions_of_unknown_agents_are_refused(pair):
    from pipeline.environments.parallel_env import PersonAnimalEnv

    env = PersonAnimalEnv(AnimalWorld.load(pair, QUICK))
    env.reset(seed=0)
    with pytest.raises(InputError, match="REC-001.*'dgo'"):
        env.step({"person": np.zeros(3), "dgo": np.zeros(2)})


def test_unknown_animals_are_refused(pair):
    with pytest.raises(InputError, match="REC-001.*'bird'\n.*cat, dog"):
        AnimalWorld.opened(pair, config=QUICK, animal="bird")
    with pytest.raises(InputError, match="REC-001.*'dog'\n.*known: animal"):
        AnimalWorld.opened(pair / "animals/cat", config=QUICK, animal="dog")


def test_animal_without_model_is_named_and_absent_where_another_one_is_met(three):
    from pipeline.environments.parallel_env import PersonAnimalEnv

    for animal in (None, "bird"):
        with pytest.raises(InputError, match="ART-003.*bird has no behavior model\n.*animal='cat'"):
            AnimalWorld.opened(three, config=QUICK, animal=animal)
    env = PersonAnimalEnv(three, config=QUICK, animal="dog")
    seen, _ = env.reset(seed=0)
    assert env.agents == ["person", "cat", "dog"]
    others = seen["person"]["others"]
    assert (others[0] == 0).all() and others[1, 0] == 1.0, "the bird is absent, the cat is there"
    assert env.observation_space("cat").contains(seen["cat"]) and seen["cat"].shape == (20,)
