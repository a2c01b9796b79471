"""A home of a cat and a dog in another home, and in several, in all environments."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.environments.world import AnimalWorld
from tests.pipeline.environments.home_of_two import write_animals
from tests.pipeline.environments.small_world import QUICK
from tests.pipeline.environments.test_homes_and_rgbd import write_surfaces
from tests.pipeline.environments.test_other_home import write

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("pettingzoo")
AWAY_M = 30.0


@pytest.fixture(scope="module")
def homes(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A build of two animals with surfaces, and another home, 30 m away."""
    folder = tmp_path_factory.mktemp("builds")
    pair, other = write(folder / "pair"), write(folder / "other")
    write_animals(pair / "animals")
    for name in ("cat", "dog"):
        shutil.copy(pair / "behavior_data/volume.npz", pair / "animals" / name / "behavior_data")
        write_surfaces(pair / "animals" / name)
    shutil.rmtree(pair / "behavior_data")
    there = npz.load(other / "behavior_data/volume.npz")
    there["origin"] = there["origin"] + np.array([AWAY_M, 0.0, 0.0])
    npz.save(other / "behavior_data/volume.npz", **there)
    write_surfaces(other)
    return pair, other


def where(world: AnimalWorld) -> dict[str, np.ndarray]:
    """Return the home, 0 or 1, that each animal of each life is in by its position, and the person."""
    place = {name: batch.past_world[:, -1, 0] for name, batch in world.batches.items()}
    return {name: (x > AWAY_M / 2).astype(int) for name, x in {**place, "person": world.eyes[:, 0]}.items()}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("animal", [None, "dog"])
def test_gymnasium_checker_passes_in_another_home(homes, animal):
    from gymnasium.utils.env_checker import check_env

    pair, other = homes
    how = {"config": QUICK, "episode_s": 2.0, "animal": animal, "home": str(other)}
    env = gymnasium.make("pipeline.environments:AgentToSim/Cat-v0", build=str(pair), **how)
    check_env(env.unwrapped)
    seen, info = env.reset(seed=0)
    world = env.unwrapped.world
    assert info["share_known"] == 1.0, "the same room"
    assert world.target == (animal or "cat") and list(world.batches) == ["cat", "dog"]
    assert all(home.all() for home in where(world).values()), "all of them are there"
    assert seen["others"][0, 0] == 1.0


@pytest.mark.filterwarnings("error")
def test_pettingzoo_checks_pass_in_two_homes(homes):
    from pettingzoo.test import parallel_api_test, parallel_seed_test

    from pipeline.environments.parallel_env import PersonAnimalEnv

    world = AnimalWorld.opened(homes[0], config=QUICK, homes=homes)
    env = PersonAnimalEnv(world)
    parallel_api_test(env, num_cycles=30)
    parallel_seed_test(lambda: PersonAnimalEnv(AnimalWorld(world.residents, QUICK)), num_cycles=20)
    _, infos = env.reset(seed=0)
    assert infos == {name: {"share_known": 1.0} for name in ("person", "cat", "dog")}


def test_animals_of_a_life_are_in_one_home_and_perceive_each_other(homes):
    lives = []
    for _ in range(2):
        how = {"config": QUICK, "episode_s": 0.5, "homes": [str(home) for home in homes], "animal": "dog"}
        env = gymnasium.make_vec(
            "pipeline.environments:AgentToSim/Cat-v0", num_envs=8, build=str(homes[0]), **how
        )
        _, info = env.reset(seed=2, options={"split": "test"})
        visited = [info["home"]]
        for _ in range(13):
            seen, *_, info = env.step(np.full((8, 3), 0.2, np.float32))
            for name, home in where(env.world).items():
                np.testing.assert_array_equal(home, info["home"], err_msg=name)
            visited.append(info["home"])
        assert set(np.concatenate(visited)) == {0, 1} and (visited[0] != visited[-1]).any()
        lives.append(seen["others"])
    np.testing.assert_array_equal(*lives)
    for name, other in (("cat", "dog"), ("dog", "cat")):
        batch, past = env.world.batches[name], env.world.batches[other].past_world
        again = info["home"] == visited[-2]
        np.testing.assert_allclose(batch.companions[again, 0, 1:, :3], past[again, :-1])


def test_camera_is_in_the_home_of_the_life(homes):
    world = AnimalWorld.opened(homes[0], config=QUICK, homes=homes, observations=("rgbd",), animal="dog")
    assert len(world.camera.scenes) == 2 and len(world.camera.bodies) == 2
    world.begin(6, np.random.default_rng(0))
    assert len(world.pictures()) == 6 and set(world.home) == {0, 1}


def test_stable_baselines_tells_the_homes(homes):
    pytest.importorskip("stable_baselines3")
    from pipeline.environments.stable_baselines import PersonStableVecEnv

    env = PersonStableVecEnv(homes[0], 4, config=QUICK, episode_s=0.3, home=homes[1])
    env.seed(0)
    env.reset()
    for _ in range(4):
        seen, *_ = env.step(np.zeros((4, 3)))
    assert env.reset_infos == [{"home": 0, "share_known": 1.0}] * 4
    assert seen["others"].shape == (4, 1, 8) and (seen["others"][:, 0, 0] == 1).all()


def test_one_of_several_moves_alone(homes):
    pair, other = homes
    alone = AnimalWorld.opened(pair / "animals/dog", config=QUICK, home=other)
    alone.begin(2, np.random.default_rng(0))
    assert list(alone.batches) == ["animal"] and where(alone)["animal"].all()


def test_other_home_without_artifacts_is_named(homes, tmp_path):
    with pytest.raises(InputError, match="ART-003.*nowhere"):
        AnimalWorld.opened(homes[0], config=QUICK, home=tmp_path / "nowhere")
