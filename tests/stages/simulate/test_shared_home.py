"""Simulation of all animals of a home, with tiny networks."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.behavior.trajectories import BehaviorData
from pipeline.core.errors import InputError
from pipeline.data import npz, ply
from pipeline.geometry.meshes import Mesh
from stages.simulate import stage
from stages.simulate.config import Config
from stages.simulate.inputs import Inputs
from stages.simulate.takes import guidance_scales
from tests.pipeline.environments import test_other_home
from tests.pipeline.environments.home_of_two import write_animals

SETTINGS = Config(seconds=6.0, observer="away", seed=3, goal_steps=4, sequence_steps=2)


@pytest.fixture(scope="module")
def animals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two animals recorded in the same sessions in one room."""
    folder = tmp_path_factory.mktemp("animals")
    write_animals(folder)
    for name in ("cat", "dog"):
        write_floor(folder / name)
    return folder


def write_floor(build: Path) -> None:
    """Write a surface of 4 x 4 m."""
    (build / "reconstruction").mkdir()
    (build / "reconstruction/manifest.json").write_text("{}")
    corners = np.array([[-2, 0, -2], [2, 0, -2], [2, 0, 2], [-2, 0, 2]], np.float32)
    floor = Mesh(corners, np.array([[0, 2, 1], [0, 3, 2]], np.int32), np.full((4, 3), 200, np.uint8))
    ply.write_ply(build / "reconstruction/scene.ply", floor)


@pytest.fixture(scope="module")
def other_home(animals: Path, tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """The same animals where a floor carries them, and another home, 20 m away, for them."""
    folder = tmp_path_factory.mktemp("other")
    shutil.copytree(animals, folder / "animals")
    own, other = (test_other_home.write(folder / name) for name in ("own", "other"))
    for name in ("cat", "dog"):
        shutil.copy(own / "behavior_data/volume.npz", folder / "animals" / name / "behavior_data")
    there = npz.load(other / "behavior_data/volume.npz")
    there["origin"] = there["origin"] + np.array([20.0, 0.0, 0.0])
    npz.save(other / "behavior_data/volume.npz", **there)
    write_floor(other)
    shared = {name: own / name for name in ("feature_basis", "scene_template")}
    return Inputs(animals=folder / "animals", home=other, **shared)


def simulated(animals: Path, out: Path, **changes: object) -> dict[str, dict[str, np.ndarray]]:
    """Run the stage and return the takes by name."""
    out.mkdir()
    stage.run(Inputs(animals=animals), replace(SETTINGS, **changes), out)
    assert (out / "from_above.jpg").stat().st_size > 1000
    return {path.parent.name: npz.load(path) for path in sorted(out.glob("*/take.npz"))}


def test_animals_perceive_and_avoid_each_other(animals, tmp_path):
    together, again = (simulated(animals, tmp_path / name) for name in ("a", "b"))
    assert list(together) == ["cat", "dog"]
    for name, take in together.items():
        np.testing.assert_array_equal(take["world_from_agent"], again[name]["world_from_agent"])
        assert len((tmp_path / f"a/{name}/take.csv").read_text().splitlines()) == 1 + 61
    alone = simulated(animals, tmp_path / "c", absent=("dog",))
    assert list(alone) == ["cat"]
    places = [take["world_from_agent"][:, :3, 3] for take in together.values()]
    np.testing.assert_array_equal(places[0][0], alone["cat"]["world_from_agent"][0, :3, 3])
    assert np.abs(places[0] - alone["cat"]["world_from_agent"][:, :3, 3]).max() > 1e-3, "meters"
    gap = np.linalg.norm((places[0] - places[1])[:, [0, 2]], axis=-1)
    assert gap[0] >= 0.4 and gap.min() > 0.3, "meters: bodies' 0.4, less what both do at once"


def test_replayed_animal_is_perceived(animals, tmp_path):
    living, replayed = (
        simulated(animals, tmp_path / name, replayed=who) for name, who in (("a", ()), ("b", ("dog",)))
    )
    data = BehaviorData.load(animals / "dog/behavior_data")
    found = replayed["dog"]["world_from_agent"]
    (same,) = [
        (track, int(at[0]))
        for track in data.trajectories.values()
        if len(at := np.flatnonzero((track.world_from_agent == found[0]).all((1, 2))))
    ]
    recorded = np.roll(same[0].world_from_agent, -same[1], axis=0)[: len(found)]
    np.testing.assert_array_equal(found, recorded)
    np.testing.assert_array_equal(living["dog"]["world_from_agent"][0], found[0])
    cats = [take["cat"]["world_from_agent"][:, :3, 3] for take in (living, replayed)]
    assert np.abs(cats[0] - cats[1]).max() > 1e-4, "meters: it reacts to the clip"


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"absent": ("bird",)}, "SIM-013.*bird.*\n.*known: cat, dog"),
        ({"replayed": ("bird",)}, "SIM-013.*bird"),
        ({"absent": ("cat", "dog")}, "SIM-013.*nobody"),
    ],
)
def test_unknown_names_are_refused(animals, tmp_path, changes, code):
    with pytest.raises(InputError, match=code):
        stage.run(Inputs(animals=animals), replace(SETTINGS, **changes), tmp_path)
    with pytest.raises(InputError, match="SIM-013"):
        stage.run(Inputs(behavior_data=animals / "cat/behavior_data"), replace(SETTINGS, **changes), tmp_path)


def test_guidance_of_one_being_changes_only_who_perceives_it(animals, tmp_path):
    usual, same, dog, person = (
        simulated(animals, tmp_path / name, observer="still", guidance=scales)
        for name, scales in (
            ("a", ()),
            ("b", ("dog=1", "cat=1.0", "person=1.25")),
            ("c", ("dog=0",)),
            ("d", ("person=0",)),
        )
    )
    first = {name: take["goal_world"][0] for name, take in usual.items()}
    for name, goal in first.items():
        np.testing.assert_array_equal(usual[name]["world_from_agent"], same[name]["world_from_agent"])
        assert np.abs(person[name]["goal_world"][0] - goal).max() > 1e-3, "meters"
    assert np.abs(dog["cat"]["goal_world"][0] - first["cat"]).max() > 1e-3, "meters"
    np.testing.assert_array_equal(dog["dog"]["goal_world"][0], first["dog"], "a dog does not perceive itself")


@pytest.mark.parametrize(
    ("written", "animals", "message"),
    [
        ("bird=2", ("cat", "dog"), "SIM-013.*'bird'.*\n.*known: cat, dog, person"),
        ("cat=2", ("cat",), "SIM-013.*'cat'.*\n.*known: person"),
        ("dog=loud", ("cat", "dog"), "SIM-013.*'dog=loud'.*\n.*dog=1.5"),
        ("person=-1", (), "SIM-013.*'person=-1'"),
        ("person", (), "SIM-013.*'person'"),
    ],
)
def test_guidance_of_nobody_is_refused(written, animals, message):
    with pytest.raises(InputError, match=message):
        guidance_scales([written], animals)


def test_all_animals_live_together_in_another_home(other_home, tmp_path):
    stage.run(other_home, replace(SETTINGS, observer="still"), tmp_path)
    takes = {name: npz.load(tmp_path / name / "take.npz") for name in ("cat", "dog")}
    places = [take["world_from_agent"][:, :3, 3] for take in takes.values()]
    for name, take in takes.items():
        about = json.loads((tmp_path / name / "home.json").read_text())
        assert about["home"] == "other" and about["share_known"] == 1.0 and about["goals_in_solid"] == 0.0
        volume = npz.load(tmp_path / name / "volume.npz")
        voxel = np.floor((take["world_from_agent"][:, :3, 3] - volume["origin"]) / volume["voxel_m"])
        assert (volume["allowed"][tuple(voxel.astype(int).T)] > 0).all(), "in the other home, in free space"
        np.testing.assert_array_equal(take["observer_world"], takes["cat"]["observer_world"])
    gap = np.linalg.norm((places[0] - places[1])[:, [0, 2]], axis=-1)
    assert gap[0] >= 0.4 and gap.min() > 0.3, "meters, as at home"
    assert (tmp_path / "from_above.jpg").stat().st_size > 1000


def test_what_cannot_be_in_another_home_is_refused(other_home, tmp_path):
    with pytest.raises(InputError, match="SIM-011.*recorded clips"):
        stage.run(other_home, replace(SETTINGS, replayed=("dog",)), tmp_path)
    with pytest.raises(InputError, match="SIM-011.*sub-goals"):
        stage.run(other_home, replace(SETTINGS, places="visited"), tmp_path)
    bare = test_other_home.write(tmp_path / "bare")
    with pytest.raises(InputError, match="ART-003.*no reconstruction"):
        stage.run(replace(other_home, home=bare), SETTINGS, tmp_path)


def test_animal_without_model_is_named(animals, tmp_path):
    (animals / "bird/behavior_data").mkdir(parents=True)
    try:
        with pytest.raises(InputError, match=r"ART-003.*bird has no reconstruction.*\n.*leave bird out"):
            stage.run(Inputs(animals=animals), SETTINGS, tmp_path)
    finally:
        (animals / "bird/behavior_data").rmdir()
        (animals / "bird").rmdir()
