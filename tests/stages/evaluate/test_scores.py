"""Scores on constructed cases, their invariances, and the treatment of failures."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from pipeline.baselines.predictors import Samples
from pipeline.behavior.trajectories import TEST, BehaviorData, Future, Trajectory
from pipeline.fields.skinning import SkinnedShape
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh, RayCaster
from pipeline.metrics import bars, scores
from pipeline.metrics.intervals import bootstrapped, episodes
from pipeline.metrics.metrics import Metrics, median, percentile
from pipeline.metrics.pose_errors import PoseErrors, constant_between, pose_errors
from pipeline.metrics.surface_distance import TriangleSurface
from stages.evaluate import behavior, heldout, registration, surfaces
from stages.evaluate.config import Config
from stages.evaluate.heldout import HeldoutShot, HeldoutView


def poses(count, seed=0, size_m=2.0):
    """Random rigid motions."""
    rng = np.random.default_rng(seed)
    return rigid.exp(
        np.concatenate([rng.normal(0, 1, (count, 3)), rng.normal(0, size_m, (count, 3))], axis=1)
    )


def test_constant_transform_is_removed():
    truth, constant = poses(30), poses(1, seed=5)[0]
    ours = constant @ truth
    ours[3] = np.nan
    ours[7] = ours[7] @ poses(1, seed=9)[0]
    found = constant_between(ours, truth)
    np.testing.assert_allclose(found, constant, atol=1e-3)
    errors = pose_errors(ours, found @ truth)
    assert np.isinf(errors.degrees[3])
    assert errors.meters[7] > 0.1
    assert np.median(errors.degrees) < 0.05


def test_alignment_does_not_absorb_scale():
    truth = poses(50)
    ours = truth.copy()
    ours[:, :3, 3] *= 1.1
    errors = pose_errors(ours, constant_between(ours, truth) @ truth)
    assert median(errors.meters) > 0.1


def test_rejected_recordings_count_as_failures():
    truth = poses(10)
    good = pose_errors(truth, truth)
    refused = pose_errors(np.full_like(truth, np.nan), truth)
    metrics = registration.camera_metrics({"a": good, "b": refused}, {"a": np.ones(10), "b": np.zeros(10)}, 1)
    assert metrics.values["registration/videos_registered"] == 1
    assert metrics.values["registration/videos_total"] == 2
    assert metrics.values["registration/rotation_deg_p95"] is None
    assert "registration/rotation_deg_p95" in metrics.reasons
    assert metrics.values["registration/at_coverage_50_translation_m_median"] == pytest.approx(0, abs=1e-9)
    assert metrics.values["registration/within_2deg_5cm_share"] == 0.5


def test_small_rotation_errors_are_exact():
    truth = poses(5)
    turned = truth @ rigid.exp(np.array([1e-4, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(pose_errors(turned, truth).degrees, np.degrees(1e-4), rtol=1e-6)


def test_infinite_failures_stay_infinite_in_percentiles():
    errors = np.array([0.0] * 18 + [np.inf] * 2)
    assert percentile(errors, 90) == np.inf or percentile(errors, 90) == 0.0
    assert percentile(errors, 95) == np.inf
    metrics = Metrics()
    metrics.put("x", percentile(errors, 95), "why")
    assert metrics.values["x"] is None
    assert metrics.reasons["x"] == "failed: why"
    metrics.put("y", float("nan"), "why")
    assert metrics.reasons["y"] == "why"


def test_failed_metrics_miss_their_bars_and_unmeasured_ones_do_not():
    failed, unmeasured = Metrics(), Metrics()
    refused = PoseErrors(np.full(9, np.inf), np.full(9, np.inf))
    nothing = PoseErrors(np.zeros(0), np.zeros(0))
    for metrics, errors in ((failed, refused), (unmeasured, nothing)):
        registration.put_cameras(metrics, errors)
        metrics.add(registration.root_metrics("reconstruction", [errors]))
    judged = ("registration/", "reconstruction/")
    assert [check.status for check in bars.checks(failed, *judged)] == ["warn"] * 3
    assert bars.checks(unmeasured, *judged) == []
    assert bars.worst(bars.judge(failed.values, failed.reasons)) == "fail"
    assert bars.worst(bars.judge(unmeasured.values, unmeasured.reasons)) == "ok"


def view(color, depth, true_color, true_depth, agent):
    true = HeldoutShot(np.eye(4), np.eye(3), 0.0, true_color, true_depth.astype(np.float32), agent)
    return HeldoutView(color, depth.astype(np.float32), true)


def test_held_out_views_count_holes_as_wrong_and_ignore_exposure():
    rng = np.random.default_rng(0)
    true_color = rng.integers(40, 200, (32, 24, 3), dtype=np.uint8)
    true_depth, agent = np.full((32, 24), 2.0), np.zeros((32, 24), bool)
    agent[:8] = True
    true_depth[-4:] = 7.0
    depth = true_depth + 0.05
    depth[:8, :12] = 0
    darker = (0.5 * true_color + 10).astype(np.uint8)
    values = heldout.view_metrics([view(darker, depth, true_color, true_depth, agent)]).values
    assert values["reconstruction/depth_acc_agent"] == 0.5
    assert values["reconstruction/depth_acc_scene"] == 1.0
    assert values["reconstruction/depth_acc_all"] == pytest.approx(1 - 8 * 12 / (28 * 24))
    assert values["reconstruction/psnr_all"] > 40
    assert values["reconstruction/lpips_all"] is None


def test_portrait_and_landscape_views_are_scored():
    views = []
    for shape, off_m in (((32, 24), 0.0), ((24, 32), 1.0)):
        color, depth = np.full((*shape, 3), 128, np.uint8), np.full(shape, 2.0)
        views.append(view(color, depth + off_m, color, depth, np.zeros(shape, bool)))
    assert heldout.view_metrics(views).values["reconstruction/depth_acc_scene"] == 0.5
    drawn = heldout.side_by_side(views)
    assert drawn.shape == (4 * 32, 24 + 32, 3)
    assert (drawn[24:32, 24:] == 0).all() and (drawn[:32, :24] == 128).all()


def test_worse_pictures_score_worse():
    rng = np.random.default_rng(0)
    true_color = rng.integers(0, 255, (40, 40, 3), dtype=np.uint8)
    depth, agent = np.ones((40, 40)), np.zeros((40, 40), bool)
    qualities = []
    for noise in (2, 20, 80):
        ours = np.clip(true_color + rng.normal(0, noise, true_color.shape), 0, 255).astype(np.uint8)
        qualities.append(heldout.picture_quality(view(ours, depth, true_color, depth, agent)))
    psnr, ssim = np.array(qualities)[:, [0, 3]].T
    assert np.all(np.diff(psnr) < 0)
    assert np.all(np.diff(ssim) < 0)


def test_only_observed_surfaces_are_visible():
    corner = np.array(
        [[-1, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2], [-1, -1, 3], [1, -1, 3], [1, 1, 3], [-1, 1, 3.0]]
    )
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    mesh = Mesh(corner.astype(np.float32), faces)
    points = TriangleSurface(mesh.vertices[mesh.faces].astype(float)).sample(2000, np.random.default_rng(0))
    lens = np.array([[[50.0, 0, 50], [0, 50, 50], [0, 0, 1]]])
    seen = surfaces.seen_by(RayCaster(mesh), points, np.eye(4)[None], lens, (100, 100))
    assert seen[points[:, 2] < 2.5].all()
    assert not seen[points[:, 2] > 2.5].any()


def test_point_tracks_follow_the_skin():
    rng = np.random.default_rng(0)
    rest = poses(2, 1).astype(np.float32)
    skin = SkinnedShape(rng.normal(size=(50, 3)), np.eye(2)[rng.integers(0, 2, 50)], rest)
    turn = poses(1, 4)[0]
    np.testing.assert_allclose(skin.posed(rest), skin.vertices, atol=1e-4)
    np.testing.assert_allclose(skin.posed(turn @ rest), rigid.apply(turn, skin.vertices), atol=1e-4)
    moved = (skin.vertices + 0.3, skin.vertices[::-1])
    assert np.array_equal(surfaces.matched_once(skin.vertices, moved), np.arange(50)[::-1]), (
        "in the frame that fits"
    )


def wandering(frames, seed):
    """An animal that walks in a straight line at a random heading."""
    rng = np.random.default_rng(seed)
    heading = rng.uniform(0, 2 * np.pi)
    position = np.arange(frames)[:, None] * 0.05 * np.array([np.sin(heading), 0, np.cos(heading)])
    root = rigid.make(rigid.rotation_from_vector(np.tile([0, heading, 0.0], (frames, 1))), position)
    bones = np.tile(np.eye(4), (frames, 3, 1, 1))
    camera = rigid.make(np.eye(3), np.tile([0, 1.5, -2.0], (frames, 1)))
    return Trajectory(np.arange(frames) / 10, root, bones, camera, np.ones(frames, bool))


@pytest.fixture(scope="module")
def data():
    trajectories = {"a": wandering(200, 0), "b": wandering(160, 1)}
    starts = {"a": np.arange(0, 136, 4), "b": np.arange(97)}
    video = np.concatenate([np.full(len(start), i) for i, start in enumerate(starts.values())])
    return BehaviorData(
        trajectories,
        np.tile(np.eye(4), (3, 1, 1)),
        video,
        np.concatenate(list(starts.values())),
        np.array([False, True]),
        ("a", "b"),
    )


class Oracle:
    """Predicts the future with a little noise."""

    def __init__(self, data):
        context, self.future = data.windows(data.indices(TEST))
        self.now = context.world_from_agent[:, -1, :3, 3]

    def sample(self, context, count, rng):
        apart = np.linalg.norm(context.world_from_agent[:, -1, None, :3, 3] - self.now, axis=-1)
        root, bones = (
            part[apart.argmin(1)] for part in (self.future.world_from_agent, self.future.agent_from_bone)
        )
        path = root[:, None, :, :3, 3] + rng.normal(0, 0.01, (len(root), count, 1, 3))
        shape = (len(root), count, *root.shape[1:2])
        rotation = np.broadcast_to(root[:, None, :, :3, :3], (*shape, 3, 3))
        return Samples(
            path[:, :, -1], path, rotation, np.broadcast_to(bones[:, None], (*shape, *bones.shape[2:]))
        )


PROTOCOL = Config(samples=8, trials=2, plan_windows=7, seed=0)


def test_oracle_is_significantly_better_than_baselines(data):
    values = behavior.behavior_metrics(data, Oracle(data), PROTOCOL).values
    assert values["behavior/ats/goal_minde_m"] < 0.02
    assert values["behavior/ats/orientation_minade_rad"] == pytest.approx(0, abs=1e-6)
    assert values["behavior/moving_windows_share"] == 1.0
    for baseline in ("location_prior", "stand_still"):
        for score in behavior.GOAL_SCORES:
            assert values[f"behavior/ats_minus_{baseline}/{score}_ci95_high"] < 0
    assert values["behavior/location_prior/path_minade_m"] is None


def test_constant_velocity_is_exact_on_straight_walks(data):
    values = behavior.behavior_metrics(data, Oracle(data), PROTOCOL).values
    assert (
        values["behavior/constant_velocity/goal_minde_m"] < 0.01 < values["behavior/stand_still/goal_minde_m"]
    )


def test_windows_of_the_whole_test_are_evaluated_and_counted(data):
    for asked, counted in ((7, 7), (120, 97)):
        values = behavior.behavior_metrics(data, Oracle(data), replace(PROTOCOL, plan_windows=asked)).values
        assert (
            values["behavior/plan_windows"] == counted
            and values["behavior/plan_trials"] == 1
            and values["behavior/test_windows"] == 97
        )
        assert values["behavior/ats_minus_stand_still/path_minade_m_ci95_high"] < 0


def test_chunked_evaluation_gives_the_same_scores(data, monkeypatch):
    few = behavior.behavior_metrics(data, Oracle(data), PROTOCOL).values
    monkeypatch.setattr(scores, "WINDOWS_AT_ONCE", 1000)
    assert behavior.behavior_metrics(data, Oracle(data), PROTOCOL).values == few
    monkeypatch.undo()
    tracemalloc.start()
    behavior.behavior_metrics(data, Oracle(data), replace(PROTOCOL, samples=32, trials=16))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6, "bytes; 512 paths in each of 97 windows take 67 MB, and their noise as much"


def test_behavior_without_test_video_is_skipped(data):
    alone = BehaviorData(
        data.trajectories, data.agent_from_bone_rest, data.video, data.start, np.zeros(2, bool), data.videos
    )
    metrics = behavior.behavior_metrics(alone, Oracle(data), PROTOCOL)
    assert metrics.values["behavior/ats/goal_minde_m"] is None
    assert "test video" in metrics.reasons["behavior/ats/goal_minde_m"]


def test_energy_score_is_minimal_for_the_true_distribution():
    rng = np.random.default_rng(0)
    truth = rng.normal(0, 1, (4000, 3))
    future = Future(np.tile(np.eye(4), (4000, 1, 1, 1)), np.zeros((4000, 1, 1, 4, 4)))
    future.world_from_agent[:, 0, :3, 3] = truth
    energy = [
        scores.goal_energy_score(Samples(rng.normal(0, std, (4000, 16, 3))), future).mean()
        for std in (0.01, 1, 3)
    ]
    assert energy[1] == min(energy)


def test_intervals_widen_for_correlated_windows():
    rng = np.random.default_rng(0)
    start = np.arange(600)
    values = np.repeat(rng.normal(size=10), 60)
    blocks = episodes(start, np.zeros(600, int), 60)
    wide = bootstrapped(values, blocks, np.random.default_rng(0))
    narrow = bootstrapped(values, start, np.random.default_rng(0))
    assert wide.high - wide.low > 3 * (narrow.high - narrow.low)
    assert wide.low <= wide.mean <= wide.high
    skewed = bootstrapped(np.append(values, 1e6), np.append(blocks, 0), np.random.default_rng(0), median=True)
    assert wide.low - 0.5 < skewed.low <= skewed.mean <= skewed.high < wide.high + 0.5


@pytest.mark.parametrize("count", [3, 6, 15])
def test_intervals_of_few_episodes_cover_the_truth(count):
    rng, covered = np.random.default_rng(0), []
    for _ in range(400):
        windows = np.repeat(rng.normal(size=count), 4)
        found = bootstrapped(windows, np.repeat(np.arange(count), 4), rng)
        covered.append(found.low <= 0 <= found.high)
    # two standard deviations of 400 draws below 95 %; quantiles of the resamples cover 75, 86 and 91 %
    assert np.mean(covered) > 0.925


def test_one_episode_alone_has_no_interval():
    found = Metrics()
    found.put_mean("goal", bootstrapped(np.arange(5.0), np.zeros(5, int), np.random.default_rng(0)))
    assert found.values == {"goal": 2.0, "goal_ci95_low": None, "goal_ci95_high": None}
    assert "one episode" in found.reasons["goal_ci95_low"]


def test_only_placed_roots_count_as_flipped():
    truth = np.tile(np.eye(4), (6, 1, 1))
    ours = truth.copy()
    ours[:2, :3, :3] = np.diag([-1.0, 1.0, -1.0])
    ours[5] = np.nan
    placed = np.array([False, True, True, True, True, True])
    found = registration.root_metrics("here", [pose_errors(ours, truth)], [placed]).values
    assert found["here/agent_flips_share"] == 1 / 4
    assert found["here/agent_placed_share"] == 4 / 6
