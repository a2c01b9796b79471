"""Simulation of all animals of a home, with tiny networks."""

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
from tests.pipeline.environments.home_of_two import write_animals

SETTINGS = Config(seconds=6.0, observer="away", seed=3, goal_steps=4, sequence_steps=2)


@pytest.fixture(scope="module")
def animals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two animals recorded in the same sessions in one room."""
    folder = tmp_path_factory.mktemp("animals")
    write_animals(folder)
    for name in ("cat", "dog"):
        (folder / name / "reconstruction").mkdir()
        (folder / name / "reconstruction/manifest.json").write_text("{}")
        corners = np.array([[-2, 0, -2], [2, 0, -2], [2, 0, 2], [-2, 0, 2]], np.float32)
        floor = Mesh(corners, np.array([[0, 2, 1], [0, 3, 2]], np.int32), np.full((4, 3), 200, np.uint8))
        ply.write_ply(folder / name / "reconstruction/scene.ply", floor)
    return folder


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


def test_animal_without_model_is_named(animals, tmp_path):
    (animals / "bird/behavior_data").mkdir(parents=True)
    try:
        with pytest.raises(InputError, match=r"ART-003.*bird has no reconstruction.*\n.*leave bird out"):
            stage.run(Inputs(animals=animals), SETTINGS, tmp_path)
    finally:
        (animals / "bird/behavior_data").rmdir()
        (animals / "bird").rmdir()
