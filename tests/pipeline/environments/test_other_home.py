"""The animal of one build in the home of another: conversion of features, start states, and diagnostics."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.backends.daisy import FeatureBasis, fit_basis
from pipeline.backends.descriptors import Describer
from pipeline.behavior.support import mark_supported
from pipeline.behavior.trajectories import PAST, TEST, TRAIN
from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.environments.moments import moments_together
from pipeline.environments.other_home import ReconstructedHome, change_basis, move_in, share_known
from tests.pipeline.behavior.wandering import room, wandering

RAW = 40


def descriptors(rng, samples=3000):
    """Descriptors in a random 12-dimensional subspace of 40 dimensions, mostly shared between homes."""
    mixing = np.random.default_rng(5).standard_normal((12, RAW))
    raw = rng.standard_normal((samples, 12)) * np.linspace(3, 1, 12) @ mixing + 2
    return (raw / np.linalg.norm(raw, axis=1, keepdims=True)).astype(np.float32)


def basis(seed):
    return fit_basis(descriptors(np.random.default_rng(seed)))


def home(volume=None, known=None, origin=(0.0, 0.0, 0.0)):
    """A room of 4 m with a floor at height 0, shifted to ``origin``."""
    volume = volume or room()
    marks = mark_supported(volume.occupancy == 0, volume.occupancy)
    volume = replace(volume, origin=volume.origin + np.array(origin))
    stands = np.array([[0.1, 0.3], [0.1, 0.3]])
    return ReconstructedHome(volume, marks, stands, known or basis(0), Describer(), origin[1])


def write(build, scale="measured", **without):
    """Write the artifacts of a home."""
    for artifact in ("behavior_data", "feature_basis", "scene_template"):
        (build / artifact).mkdir(parents=True)
    made = home()
    arrays = vars(made.volume) | {"allowed": made.marks, "stands_m": made.stands_m}
    npz.save(
        build / "behavior_data/volume.npz",
        **{
            name: without.get(name, value)
            for name, value in arrays.items()
            if without.get(name, 0) is not None
        },
    )
    made.basis.save(build / "feature_basis")
    made.describer.save(build / "feature_basis")
    (build / "scene_template/world.json").write_text(json.dumps({"scale": scale}))
    return build


def test_features_are_converted_to_the_other_basis():
    written, read = basis(1), basis(2)
    raw = descriptors(np.random.default_rng(9), 500)
    there, here = written.project(raw), read.project(raw)
    cells = np.moveaxis(there.reshape(5, 10, 10, 16), -1, 0).astype(np.float16)
    got = np.moveaxis(change_basis(cells, written, read), 0, -1).reshape(-1, 16).astype(np.float32)
    as_they_were = np.median((there * here).sum(1))
    assert np.median((got * here).sum(1)) > 0.95 > as_they_were
    np.testing.assert_allclose(np.linalg.norm(got, axis=1), 1, atol=2e-3)
    empty = change_basis(np.zeros_like(cells), written, read)
    assert not empty.any(), "free space stays empty"
    assert change_basis(cells, written, FeatureBasis(**vars(written))) is cells


def test_start_states_are_on_the_other_floor_in_free_space():
    own, other = home(), home(origin=(10.0, 2.0, -7.0))
    data = wandering()
    moved = move_in({"cat": (own, data)}, other)["cat"]
    assert set(moved.data.split) == {TRAIN, TEST}
    scenes = moved.home.scenes()
    for name, track in moved.data.trajectories.items():
        assert track.valid.sum() == PAST and len(track.valid) == PAST + data.future
        roots = track.world_from_agent[:PAST, :3, 3]
        assert not scenes.inside_solid(roots[None], None).any()
        assert (np.abs(roots[-1] - [10, 2.2, -7])[[0, 2]] < 2.2).all()
        assert 2.1 <= roots[-1, 1] <= 2.3, "as high above the floor as at home"
        video, start = name.rsplit("-", 1)
        before = data.trajectories[video].world_from_agent[int(start) :][:PAST, :3, 3]
        np.testing.assert_allclose(
            np.linalg.norm(np.diff(roots, axis=0), axis=1), np.linalg.norm(np.diff(before, axis=0), axis=1)
        )
    again = move_in({"cat": (own, data)}, other)["cat"]
    np.testing.assert_array_equal(
        again.data.windows(np.arange(5))[0].world_from_agent,
        moved.data.windows(np.arange(5))[0].world_from_agent,
    )


def test_animals_begin_together_as_they_were_at_home():
    own, other = home(), home(origin=(10.0, 2.0, -7.0))
    data = {name: wandering(seed) for seed, name in enumerate(("cat", "dog"))}
    moved = move_in({name: (own, each) for name, each in data.items()}, other)
    cat, dog = (each.data for each in moved.values())
    assert cat.videos == dog.videos and set(cat.split) == {TRAIN, TEST}
    for window in range(len(cat.videos)):
        found = moments_together({"cat": cat, "dog": dog}, "cat", window, int(cat.split[window]))
        assert found["dog"] == window, "the same moment of the other"
        video, start = cat.videos[window].rsplit("-", 1)
        (recorded,) = np.flatnonzero(
            (np.array(data["cat"].videos)[data["cat"].video] == video) & (data["cat"].start == int(start))
        )
        begun = moments_together(data, "cat", int(recorded), int(cat.split[window]))
        gaps = [
            np.diff([each["cat"].place_world[k["cat"]], each["dog"].place_world[k["dog"]]], axis=0)
            for each, k in ((data, begun), ({"cat": cat, "dog": dog}, found))
        ]
        level = [np.hypot(gap[0, 0], gap[0, 2]) for gap in gaps]
        assert level[0] == pytest.approx(level[1], abs=1e-5), "meters: as far apart as at home"
        cameras = [each.trajectories[cat.videos[window]].world_from_camera for each in (cat, dog)]
        np.testing.assert_array_equal(*cameras, "one person for all")
        roots = dog.trajectories[cat.videos[window]].world_from_agent[None, :PAST, :3, 3]
        assert not moved["dog"].home.scenes().inside_solid(roots, None).any()


def test_each_animal_begins_where_its_own_body_fits():
    """A cat fits under a board at half height; a dog's root is above it, but its body would be in it."""
    volume = room()
    occupancy = volume.occupancy.copy()
    occupancy[:22, int((0.65 - volume.origin[1]) / volume.voxel_m)] = 1
    other, data = home(replace(volume, occupancy=occupancy)), {"cat": wandering(0), "dog": wandering(1)}
    for track in data["dog"].trajectories.values():
        track.world_from_agent[:, 1, 3] += 0.6
    owns = {"cat": home(), "dog": replace(home(), stands_m=np.array([[0.62, 0.9], [0.62, 0.9]]))}
    moved = move_in({name: (own, data[name]) for name, own in owns.items()}, other)
    assert moved["cat"].home.marks[4:18].any() and not moved["dog"].home.marks[4:18].any()
    for each in moved.values():
        scenes = each.home.scenes()
        for track in each.data.trajectories.values():
            assert not scenes.inside_solid(track.world_from_agent[None, :PAST, :3, 3], None).any()


def test_unseen_features_reduce_the_fraction_of_known_cells():
    own = home()
    assert share_known(own, own) == 1.0
    strange = room()
    unlike = strange.features.copy()
    half = np.arange(strange.occupancy.shape[0]) >= 22
    noise = np.random.default_rng(0).standard_normal(unlike[:, half].shape)
    solid = strange.occupancy[half] == 1
    unlike[:, half] = np.where(solid, noise / np.linalg.norm(noise, axis=0), 0)
    share = share_known(own, home(replace(strange, features=unlike)))
    assert 0.3 < share < 0.7, "half of the room is as it was"


@pytest.mark.parametrize(
    ("fault", "code"),
    [({"stands_m": None}, "ART-007"), ({"scale": "relative: from pictures"}, "SIM-011"),
     ({"allowed": np.zeros((44, 12, 44), np.uint8)}, "SIM-011")],
)  # fmt: skip
def test_unusable_homes_are_refused(tmp_path, fault, code):
    with pytest.raises(InputError, match=code):
        ReconstructedHome.of_build(write(tmp_path / "other", **fault))


def test_missing_homes_and_other_folders_are_refused(tmp_path):
    with pytest.raises(InputError, match="ART-003(.|\n)*make <agent>.behavior_data"):
        ReconstructedHome.of_build(tmp_path / "nowhere")
    (tmp_path / "pair/animals/cat").mkdir(parents=True)
    with pytest.raises(InputError, match="ART-003(.|\n)*pair/animals/<name>"):
        ReconstructedHome.of_build(tmp_path / "pair")
    build = write(tmp_path / "other")
    other = ReconstructedHome.of_build(build)
    np.testing.assert_array_equal(other.marks, home().marks)
    (build / "behavior_data/volume.npz").unlink()
    with pytest.raises(InputError, match="SIM-011.*each recording"):
        ReconstructedHome.of_build(build)
    animals = {"cat": (home(), wandering())}
    with pytest.raises(InputError, match="SIM-011.*dinov2"):
        move_in(animals, replace(other, describer=Describer("dinov2", "somewhere")))
    coarse = replace(other, volume=replace(other.volume, voxel_m=0.2))
    with pytest.raises(InputError, match="ART-007"):
        move_in(animals, coarse)
