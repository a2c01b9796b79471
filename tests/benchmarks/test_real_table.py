"""What the benchmark prints, what it skips, and its baselines on tracks whose answer is known."""

import json
import sys

import numpy as np
import pytest

from benchmarks.real import __main__ as command
from benchmarks.real.forecasts import COLLISION_M, StraightOn, collisions, judge
from benchmarks.real.rows import ROWS
from benchmarks.real.table import HEADER, Row, markdown
from pipeline.behavior.trajectories import Context, Future


def straight(windows: int = 3) -> tuple[Context, Future]:
    """People who walk straight on, at 1 m per frame along x."""
    poses = np.tile(np.eye(4), (windows, 20, 1, 1))
    poses[..., 0, 3] = np.arange(20)
    bones = np.tile(np.eye(4), (windows, 20, 1, 1, 1))
    return Context(poses[:, :8], bones[:, :8], poses[:, :8, :3, 3]), Future(poses[:, 8:], bones[:, 8:])


def test_missing_data_is_skipped_with_its_layout(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["real", str(tmp_path), "--out", str(tmp_path / "out")])
    command.main()
    text = capsys.readouterr().out
    assert all(kind.layout in text for kind in ROWS.values())
    stored = json.loads((tmp_path / "out" / "table.json").read_text())
    assert stored["rows"] == [] and stored["skipped"].keys() == ROWS.keys()


def test_one_line_per_row():
    row = Row("paths", "some", "m", "0.2", {"still": "0.4"}, {"theirs": "0.1"}, "<= 0.3", True)
    lines = markdown([row], {"flow": "Expected a folder."}, "today").splitlines()
    assert lines[2] == "| paths | some | m | 0.2 | still 0.4 | theirs 0.1 | <= 0.3 | yes |"
    assert all(line.count("|") == len(HEADER) + 1 for line in lines[:3])
    assert "- flow: skipped. Expected a folder." in lines


def test_constant_velocity_is_exact_on_straight_walks():
    context, future = straight()
    rng = np.random.default_rng(0)
    scores = judge(StraightOn(12).sample(context, 4, rng), future)
    assert scores.ade_m.max() < 1e-9 and scores.fde_m.max() < 1e-9
    still = judge(StraightOn(12, share=0.0).sample(context, 4, rng), future)
    assert still.fde_m == pytest.approx(12.0)
    noisy = StraightOn(12, 0.4).sample(context, 200, rng)
    length = np.linalg.norm(noisy.goal - context.world_from_agent[:, -1, None, :3, 3], axis=-1)
    np.testing.assert_allclose(length, 12.0)


def test_collisions_need_the_same_place_at_the_same_time():
    path = np.zeros((1, 12, 3))
    path[0, :, 0] = np.arange(12)
    meets = np.full((12, 2, 2), np.nan)
    meets[5, 0] = [5.0, COLLISION_M / 2]
    late = np.roll(meets, 1, axis=0)
    assert collisions(path, meets).all() and not collisions(path, late).any()
