"""Pedestrian forecasting on synthetic ETH/UCY files: windows, headings, no leakage from the future."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.real import walkers
from benchmarks.real.crowds import FUTURE, PAST, Crowd, Walk
from benchmarks.real.table import HEADER
from pipeline.behavior.trajectories import TEST
from stages.train_behavior.config import BehaviorOptimizerConfig

STEPS = 30


def position(seed: int) -> np.ndarray:
    """Five people who walk nearly straight; the last appears late, the fourth disappears early."""
    rng = np.random.default_rng(seed)
    velocity = rng.normal(0, 0.4, (5, 2)) + rng.normal(0, 0.03, (STEPS, 5, 2))
    places = rng.normal(0, 2, (5, 2)) + velocity.cumsum(0)
    places[PAST + FUTURE - 4 :, 3] = np.nan
    places[:6, 4] = np.nan
    return places.round(4)


def write(path, places: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    step, person = np.nonzero(np.isfinite(places[..., 0]))
    rows = np.column_stack([780 + 10 * step, 1 + person, places[step, person]])
    np.savetxt(path, rows, fmt="%.4f", delimiter="\t")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("eth_ucy")
    write(folder / "train" / "elsewhere.txt", position(1))
    write(folder / "test" / "here.txt", position(2))
    return folder


@pytest.fixture(scope="module")
def fold(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("fold")
    train, test = walkers.crowds(data / "train"), walkers.crowds(data / "test")
    return walkers.prepare_fold(train, test, folder / "trajectories", folder), folder


def tiny_config():
    optimization = BehaviorOptimizerConfig(steps=4, goal_steps=2, batch=8, goal_batch=8)
    return replace(walkers.MODEL, training=replace(walkers.MODEL.training, optimization=optimization))


def test_windows_contain_people_who_are_present_throughout(tmp_path):
    write(tmp_path / "a.txt", position(0))
    crowd = Crowd.read(tmp_path / "a.txt")
    np.testing.assert_allclose(crowd.position, position(0))
    walks = crowd.walks()
    whole = STEPS - PAST - FUTURE + 1
    assert walks[0] == Walk(0, 0) and len(walks) == 3 * whole + whole - 6
    assert crowd.accompanied(walks).all()
    alone = Crowd(crowd.position[:, :1])
    assert not alone.accompanied(alone.walks()).any()


def test_headings_are_causal(tmp_path):
    crowd = Crowd(position(0))
    for step in range(PAST, STEPS - 1):
        changed = crowd.position.copy()
        changed[step + 1 :] += 7.0
        known = crowd.heading(0)[: step + 1]
        np.testing.assert_array_equal(Crowd(changed).heading(0)[: step + 1], known)


def test_forecasts_do_not_depend_on_the_future(fold, data, tmp_path):
    """Forecasts do not change if all future positions change."""
    true, folder = fold
    known = 3 + PAST  # steps known to windows that start at step 3
    places = true.crowds["here"].position.copy()
    places[known:] = np.where(np.isfinite(places[known:]), 5.0 - places[known:], np.nan)
    trajectories = tmp_path / "trajectories"
    shutil.copytree(folder / "trajectories" / "elsewhere", trajectories / "elsewhere")
    crowds = {"here": Crowd(places)}
    changed = walkers.prepare_fold(walkers.crowds(data / "train"), crowds, trajectories, tmp_path)
    model, forecasts, futures = walkers.train_model(folder, tiny_config(), "behavior-0"), [], []
    for each in (true, changed):
        number = [window.number for window in each.forecast_windows() if window.walk.start == 3]
        context, future = each.data.windows(np.array(number))
        forecasts.append(walkers.forecast(each, model, context, np.random.default_rng(0)).path)
        futures.append(future.path_world)
    assert len(forecasts[0]) == 3 and np.abs(futures[0] - futures[1]).max() > 1.0
    np.testing.assert_allclose(forecasts[0], forecasts[1], atol=1e-6)


def test_behavior_data_has_the_windows_of_the_recording(fold):
    """Windows agree with the file in number, time and position."""
    true, _ = fold
    windows, crowd = true.forecast_windows(), true.crowds["here"]
    assert len(windows) == len(true.data.indices(TEST)) == len(crowd.walks())
    context, future = true.data.windows(np.array([window.number for window in windows]))
    path = np.concatenate([context.world_from_agent[..., :3, 3], future.path_world], axis=1)[..., ::2]
    for window, found in zip(windows, path, strict=True):
        walk = window.walk
        place = crowd.position[walk.start : walk.start + PAST + FUTURE, walk.person]
        np.testing.assert_allclose(found, place, atol=1e-6)
    companions = context.companions[:, :, -1]
    assert np.isfinite(companions[..., 0]).sum(1).min() >= 3, (
        "all others are perceived, not the nearest alone"
    )


@pytest.mark.slow
def test_row_is_computed_from_files(fold, data, monkeypatch):
    _, folder = fold
    monkeypatch.setattr(walkers, "MODEL", tiny_config())
    monkeypatch.setattr(walkers, "SCENES", ("eth",))
    (folder / "in").mkdir()
    (folder / "in" / "eth").symlink_to(data)
    shutil.copytree(folder / "trajectories", folder / "out" / "eth_ucy" / "trajectories")
    shutil.copytree(folder / "behavior_data", folder / "out" / "eth_ucy" / "eth" / "behavior_data")
    row = walkers.row(folder / "in", folder / "out")
    assert row.met is not None and len(row.cells()) == len(HEADER)
    scene = row.detail["scenes"]["eth"]
    assert scene["windows"]["judged"] == scene["windows"]["all"]
    assert scene["truth"]["ade_m"] == 0.0
    assert scene["constant velocity"]["ade_m"] < scene["standing still"]["ade_m"]
