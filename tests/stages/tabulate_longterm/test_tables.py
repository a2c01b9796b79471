from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.baselines import longterm_networks
from pipeline.longterm.clip_channels import Clips
from pipeline.longterm.config import MotionOptimizationConfig
from pipeline.longterm.examples import DatasetSplit, encode_selection, select_clips
from pipeline.longterm.short_motions import BodyMotion
from stages.tabulate_longterm import bars, comparison, lengths, methods, samples, scores, tables
from stages.tabulate_longterm.config import Config
from stages.tabulate_longterm.reading import MotionSource
from tests.pipeline.behavior.wandering import wandering
from tests.pipeline.longterm import strider
from tests.pipeline.longterm.strider import SIZES

SMALL = Config(clips=6, optimized_clips=4, optimization=MotionOptimizationConfig(steps=5, vertices=30))


@pytest.fixture(scope="module")
def source():
    train, held = strider.dataset(count=2), strider.dataset(seed=7, count=2)
    model, rng = strider.untrained_model(train), np.random.default_rng(0)
    traveled = select_clips(train, rng, stride=20, resting=0.0)
    bank = encode_selection(train, traveled, model.poses, SIZES.points, rng)
    ablated = {
        name: longterm_networks.build(kind, SIZES).eval()
        for name, kind in longterm_networks.ABLATIONS.items()
    }
    split = DatasetSplit(train, held, ("held_out", "unseen"))
    return MotionSource(split, model, ablated, bank)


def test_errors_of_true_and_shifted_motion(source):
    dataset, model = source.split.held_out, source.ours
    part = dataset.stretches[0][:61]
    reference = scores.references([part], np.array([0]), dataset, model)[0]
    metrics = dict(zip(scores.METRICS, scores.score(part, reference, model.poses, np.zeros(1)), strict=True))
    assert all(metrics[name] == pytest.approx(0, abs=1e-6) for name in scores.METRICS[:6])
    assert metrics["contact"] == 1 and metrics["slide_m_s"] < 0.01 and metrics["planted"] > 0.5
    step = np.linalg.norm(np.diff(part.world_from_agent[:, :3, 3], axis=0)[[0, -1]], axis=1).mean()
    assert metrics["neighbor_v2v_mm"] == pytest.approx(1000 * step, rel=0.5)
    root = part.world_from_agent.copy()
    root[:, :3, 3] += [0.03, 0.0, 0.04]
    metrics = dict(
        zip(
            scores.METRICS,
            scores.score(BodyMotion(root, part.agent_from_bone), reference, model.poses, np.zeros(1)),
            strict=True,
        )
    )
    assert metrics["translation"] == pytest.approx(100 * 0.07 / 3)
    for name in ("mpjpe_mm", "mpvpe_mm"):
        assert metrics[name] == pytest.approx(50, abs=0.01)
    assert metrics["end_v2v_share"] == pytest.approx(0.05 / dataset.body.length_m, rel=1e-3)
    assert metrics["orientation"] == metrics["pose"] == pytest.approx(0, abs=1e-6)


def test_memory_bank_retrieves_its_own_clips(source):
    found = methods.nearest(source.bank, source.bank)
    torch.testing.assert_close(found, source.bank.channels)


def test_route_and_cvae_keeps_the_route(source):
    bank, pair = source.bank, np.arange(2)
    some = Clips(bank.world_from_clip[pair], bank.channels[pair], bank.seen[pair], bank.scene[pair])
    made = methods.route_cvae(source.ours, some, source.split.train, np.random.default_rng(0))
    route = source.ours.route(some.channels[:, 0], some.channels[:, -1], some.seen)
    torch.testing.assert_close(made[..., :9], route)
    assert made.shape == some.channels.shape


def test_tables_hold_every_method_with_intervals(source):
    found = comparison.figures("longterm", source, SMALL)
    for method in (
        "truth",
        "ours",
        "ours_opt",
        "base",
        "base_opt",
        "route_cvae_opt",
        "nearest_opt",
        *longterm_networks.ABLATIONS,
    ):
        low, mean, high = (
            found[f"longterm/{method}/mpjpe_mm{end}"] for end in ("_ci95_low", "", "_ci95_high")
        )
        assert low <= mean <= high, method
    assert found["longterm/truth/mpjpe_mm"] == 0 < found["longterm/ours/mpjpe_mm"]
    apart = found["longterm/base/mpjpe_mm"] - found["longterm/ours/mpjpe_mm"]
    assert found["longterm/base_beyond_ours/mpjpe_mm"] == pytest.approx(apart)
    for method in ("ours", "ours_opt", "base_opt"):
        assert found[f"longterm/{method}/end_v2v_share"] < 1e-4, (
            "given ends are kept, by the networks and by the optimization"
        )
    assert found["longterm/ours_opt/seam_share"] < 0.05
    for seconds in (2, 4, 6):
        assert (
            found[f"longterm_{seconds}s/truth/mpvpe_mm"]
            == 0
            < found[f"longterm_{seconds}s/ours_opt/mpvpe_mm"]
        )
        assert found[f"longterm_{seconds}s/ours_opt/end_v2v_share"] < 1e-4
        assert (found[f"longterm_{seconds}s/base_opt/seam_worst_mm"] is None) == (seconds == 2)
    assert "longterm_unseen/ours/mpvpe_mm" in found and "longterm_unseen/ours_opt/mpvpe_mm" not in found
    text = tables.text(found)
    sources = {name.split("/")[0] for name in found}
    assert text.count("Table 1") == text.count("Table 4") == len(sources) - 3
    assert text.count("the body given every 2 s") == 3
    assert len(bars.checks(found)) > 10


def test_clips_are_paired_and_the_gap_at_the_joint_is_measured(source):
    dataset, model = source.split.held_out, source.ours
    traveled = select_clips(dataset, np.random.default_rng(0), stride=10, resting=0.0)
    cuts = comparison.select_runs(traveled, 2, 6)
    assert len(cuts.start) == 6 and set(cuts.start[1::2] - cuts.start[::2]) == {60}
    assert (cuts.stretch[1::2] == cuts.stretch[::2]).all()
    assert comparison.even_runs(7, 2, 4).tolist() == [0, 1, 4, 5] and not len(comparison.even_runs(0, 2, 4))
    threes = comparison.select_runs(traveled, 3, 6).start
    assert len(threes) == 6 and set(np.diff(threes.reshape(-1, 3)).reshape(-1)) == {60}
    parts = cuts.parts(dataset)
    known = scores.references(parts, np.zeros(6, int), dataset, model)
    seam = scores.METRICS.index("seam_share")
    whole = scores.score_pairs(parts, known, model)[:, seam]
    moved = parts[1].world_from_agent.copy()
    moved[1:, 0, 3] += 0.05
    torn = scores.score_pairs(
        [parts[0], BodyMotion(moved, parts[1].agent_from_bone), *parts[2:]], known, model
    )[:, seam]
    assert whole.max() < 0.02 < (torn - whole)[:2].min()
    np.testing.assert_array_equal(torn[2:], whole[2:])


def test_long_takes_are_measured(source):
    found = lengths.figures(source, replace(SMALL, minutes_s=12.0, subgoals=3))
    assert found["longterm_minutes/seconds"] >= 12.0
    assert found["longterm_minutes/subgoals"] == 3
    assert found["longterm_minutes/outside_room_m"] < 0.05


def test_samples_of_training_windows_are_never_measured(source, monkeypatch, tmp_path):
    data, chosen = wandering(), []

    def rows(world, data, windows, *_):
        chosen.extend(windows)
        return np.ones((len(windows), 2, 4))

    monkeypatch.setattr(samples, "rows", rows)
    for tested, count in ((data.tested, SMALL.samples), (data.tested & False, 0)):
        chosen.clear()
        recorded = replace(source, data=replace(data, tested=tested))
        split = recorded.data.split
        found = samples.figures(recorded, tmp_path, tmp_path, SMALL, "cpu")
        assert found.get("longterm_samples/windows", 0) == min(count, (split == 1).sum()) == len(chosen)
        assert (split[chosen] == 1).all()


def test_clips_with_an_obstacle_between_their_ends_are_marked(source):
    """Only clips with ends on opposite sides of the block have it in between."""
    clips = comparison.encode_selection(
        source.split.held_out,
        select_clips(source.split.held_out, np.random.default_rng(0), stride=5),
        source.ours.poses,
        4,
        np.random.default_rng(0),
    )
    around = clips.channels.clone()
    inverse = torch.from_numpy(np.linalg.inv(clips.world_from_clip)).float()
    for frame, place in ((0, [-1.2, 0.2, 0.0]), (-1, [1.2, 0.2, 0.0])):
        around[:, frame, :3] = inverse[:, :3, :3] @ torch.tensor(place) + inverse[:, :3, 3]
    assert comparison.blocked(replace(clips, channels=around), source.split.held_out).all()
    for frame, place in ((0, [-1.2, 0.2, 1.2]), (-1, [1.2, 0.2, 1.2])):
        around[:, frame, :3] = inverse[:, :3, :3] @ torch.tensor(place) + inverse[:, :3, 3]
    assert not comparison.blocked(replace(clips, channels=around), source.split.held_out).any()
