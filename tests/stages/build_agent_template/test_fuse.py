"""Surfaces extracted from a fused volume keep their size and have no fragments."""

import numpy as np
import pytest
import trimesh

from pipeline.core.errors import InputError
from pipeline.geometry.tsdf import Volume
from stages.build_agent_template.config import Config
from stages.build_agent_template.fuse import TRUNCATION_M, extract

RADIUS_M, SIDE_M = 0.03, 0.2


def ball(options: Config, middle: np.ndarray, scrap: bool) -> Volume:
    """A ball as thick as a leg with an attached sheet one cell thin."""
    cells = int(SIDE_M / options.voxel_m)
    volume = Volume(np.full(3, -SIDE_M / 2), (cells, cells, cells), options.voxel_m, TRUNCATION_M)
    place = volume.origin + np.stack(np.indices(volume.weight.shape), axis=-1) * options.voxel_m
    volume.distance[:] = np.clip((np.linalg.norm(place - middle, axis=-1) - RADIUS_M) / TRUNCATION_M, -1, 1)
    if scrap:
        volume.distance[cells // 2, cells // 2 : -4, cells // 2 : cells // 2 + 3] = -0.1
    volume.weight[:] = 1
    return volume


def test_animal_of_hardly_any_voxel_is_refused():
    volume = ball(Config(), np.zeros(3), scrap=False)
    seen_through = np.ones(volume.weight.shape)
    with pytest.raises(InputError, match="AGT-001"):
        extract(volume, seen_through, seen_through < 1, 2500)


@pytest.mark.parametrize("scrap", [False, True])
def test_smoothing_preserves_round_shapes(scrap):
    options, found_m = Config(), []
    for middle in np.random.default_rng(0).uniform(-0.5, 0.5, (4, 3)) * options.voxel_m:
        volume = ball(options, middle, scrap)
        nowhere = np.zeros(volume.weight.shape)
        mesh = extract(volume, nowhere, nowhere > 0, options.vertices).mesh
        surface = trimesh.Trimesh(mesh.vertices, mesh.faces)
        assert surface.is_watertight
        found_m.append((surface.volume / (4 / 3 * np.pi)) ** (1 / 3))
    assert np.mean(found_m) == pytest.approx(RADIUS_M, abs=0.0008), (
        "28.0 mm are left where nothing makes up for smoothing"
    )
