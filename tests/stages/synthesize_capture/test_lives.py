"""Simulated motion without rendering: habitable homes, volumes that agree with trajectories, paired
approaches.
"""

import numpy as np
import pytest

from pipeline.behavior.trajectories import PAST
from pipeline.metrics.flight import flees
from stages.synthesize_capture import dwellings, voxels
from stages.synthesize_capture.lives import approaches, lives


@pytest.fixture(scope="module")
def home():
    return dwellings.furnish_otherwise(np.random.default_rng(3))


def test_homes_differ(home):
    other = dwellings.furnish_otherwise(np.random.default_rng(4))
    where = {s.name: (s.x, s.z) for s in home.standing}
    there = {s.name: (s.x, s.z) for s in other.standing}
    assert where.keys() == there.keys()
    assert np.median([np.hypot(*np.subtract(where[n], there[n])) for n in where]) > 0.5
    assert {place.name for place in home.places} >= {"sofa", "cat tree", "bowl", "window"}


def test_animal_never_walks_through_solid_voxels(home):
    rng = np.random.default_rng(0)
    life = lives.lived(dwellings.rearranged(home, rng), rng, 30.0, takes=2)
    assert np.flatnonzero(np.diff(life.timestamp_s) > 1).tolist() == [149], (
        "two takes, and no window over both"
    )
    voxel, inside = life.volume.voxel(life.world_from_agent[:, :3, 3])
    assert inside.all()
    assert (life.volume.occupancy[tuple(voxel.T)] == 1).mean() < 0.01
    assert (life.volume.occupancy[:, 3:6] == 1).mean() > 0.1
    lengths = np.linalg.norm(life.volume.features.astype(float), axis=0)
    np.testing.assert_allclose(lengths[life.volume.occupancy == 1], 1, atol=2e-3)
    assert lengths[life.volume.occupancy == 0].max() == 0


def test_features_of_furniture_are_the_same_in_every_home(home):
    volume = voxels.volume_of(home)
    sofa = next(s for s in home.standing if s.name == "sofa")
    voxel, _ = volume.voxel(np.array([sofa.x, 0.25, sofa.z]))
    code = volume.features[(slice(None), *voxel)].astype(float)
    assert code @ voxels.CODES[voxels.KINDS.index("sofa")] == pytest.approx(1, abs=1e-2)


def test_paired_approaches_start_equal_and_end_differently(home):
    met = approaches.scripted(home, np.random.default_rng(0), 12)
    root = met.world_from_agent[..., :3, 3]
    walked = np.linalg.norm(met.observer[:, :, -1] - met.observer[:, :, 0], axis=-1)
    assert walked[0].min() > 0.3
    assert walked[1].max() < 1e-6
    away = np.linalg.norm((root[0, :, PAST - 1] - met.observer[0, :, -1])[:, [0, 2]], axis=-1)
    assert (away > 0.9).all()
    fled = flees(root[:, :, PAST:], root[:, :, PAST - 1], met.observer[:, :, -1])
    assert fled[0].mean() >= 0.6
    assert fled[1].mean() < 0.3


def test_simulation_is_deterministic(home, tmp_path):
    for name in ("a", "b"):
        rng = np.random.default_rng(5)
        lives.write(tmp_path / name, lives.lived(dwellings.rearranged(home, rng), rng, 3.0))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
