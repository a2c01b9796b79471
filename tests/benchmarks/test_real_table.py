"""The printed table, skipped rows, and baselines on tracks with known results."""

import json
import sys

import numpy as np
import pytest

from benchmarks.real import __main__ as command
from benchmarks.real.forecasts import COLLISION_M, ConstantVelocityPath, collisions, score_forecasts
from benchmarks.real.rows import ROWS
from benchmarks.real.table import HEADER, Row, markdown
from pipeline.behavior.trajectories import Context, Future


def straight_walks(windows: int = 3) -> tuple[Context, Future]:
    """People who walk along x at 1 m per frame."""
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


def test_markdown_has_one_line_per_row():
    row = Row("paths", "some", "m", "0.2", {"still": "0.4"}, {"theirs": "0.1"}, "<= 0.3", True)
    lines = markdown([row], {"flow": "Expected a folder."}, "today").splitlines()
    assert lines[2] == "| paths | some | m | 0.2 | still 0.4 | theirs 0.1 | <= 0.3 | yes |"
    assert all(line.count("|") == len(HEADER) + 1 for line in lines[:3])
    assert "- flow: skipped. Expected a folder." in lines


def test_constant_velocity_is_exact_on_straight_walks():
    context, future = straight_walks()
    rng = np.random.default_rng(0)
    scores = score_forecasts(ConstantVelocityPath(12).sample(context, 4, rng), future)
    assert scores.ade_m.max() < 1e-9 and scores.fde_m.max() < 1e-9
    still = score_forecasts(ConstantVelocityPath(12, speed_factor=0.0).sample(context, 4, rng), future)
    assert still.fde_m == pytest.approx(12.0)
    noisy = ConstantVelocityPath(12, 0.4).sample(context, 200, rng)
    length = np.linalg.norm(noisy.goal - context.world_from_agent[:, -1, None, :3, 3], axis=-1)
    np.testing.assert_allclose(length, 12.0)


def test_collisions_require_the_same_position_at_the_same_time():
    path = np.zeros((1, 12, 3))
    path[0, :, 0] = np.arange(12)
    other = np.full((12, 2, 2), np.nan)
    other[5, 0] = [5.0, COLLISION_M / 2]
    delayed = np.roll(other, 1, axis=0)
    assert collisions(path, other).all() and not collisions(path, delayed).any()
