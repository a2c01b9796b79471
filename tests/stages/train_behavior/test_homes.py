"""One model for several homes: goals and paths from all of them, bodies from the home of the animal alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import TEST, TRAIN
from pipeline.core.errors import InputError
from pipeline.environments.homes import Habitat
from pipeline.environments.other_home import ReconstructedHome
from stages.train_behavior.batches import (
    draw_batch,
    largest_turn_rad,
    statistics_from_windows,
    windows_from_data,
)
from stages.train_behavior.config import AugmentationConfig, BehaviorTrainingConfig, Config, ObjectiveConfig
from stages.train_behavior.homes import windows_of_all, with_other_homes
from stages.train_behavior.objective import sequence_rows
from stages.train_behavior.scene_sampler import SceneSampler
from stages.train_behavior.stage import Inputs, run
from tests.pipeline.behavior.wandering import ARCHITECTURE, BONES, wandering
from tests.pipeline.environments.test_other_home import write

MORE_BONES = BONES + 2


@pytest.fixture(scope="module")
def builds(tmp_path_factory):
    """Two builds of one animal; the second has more bones."""
    folder = tmp_path_factory.mktemp("homes")
    own, other = write(folder / "own"), write(folder / "other")
    data = wandering()
    data.save(own / "behavior_data")
    grown = {name: replace(track, agent_from_bone=np.tile(np.eye(4), (len(track.valid), MORE_BONES, 1, 1)))
             for name, track in data.trajectories.items()}  # fmt: skip
    rest = np.tile(np.eye(4), (MORE_BONES, 1, 1))
    replace(data, trajectories=grown, agent_from_bone_rest=rest).save(other / "behavior_data")
    return own, other


@pytest.fixture(scope="module")
def learned(builds):
    own, other = builds
    data = wandering()
    scenes = Scenes.load(own / "behavior_data", data.videos)
    return with_other_homes(data, scenes, ReconstructedHome.of_build(own), [other])


def test_training_windows_of_both_homes_and_test_windows_of_its_own(learned):
    data, own = wandering(), learned.home_of_window == 0
    assert len(learned.data.indices(TRAIN)) == 2 * len(data.indices(TRAIN))
    assert len(learned.data.indices(TEST)) == len(data.indices(TEST))
    assert own[learned.data.indices(TEST)].all() and not own[learned.data.indices(TRAIN)].all()
    scene = learned.scenes.number(learned.data.video, len(own))
    assert set(scene[own]) == {0} and set(scene[~own]) == {1}


def test_homes_are_sampled_with_equal_probability(learned):
    data = learned.data
    few = np.concatenate([data.indices(TRAIN)[:5], data.indices(TRAIN)[len(data.indices(TRAIN)) // 2 :]])
    some = replace(data, **{name: getattr(data, name)[few] for name in ("video", "start")})
    drawn = windows_of_all(replace(learned, data=some))
    home = learned.home_of_video[some.video[drawn]]
    assert (home == 0).sum() == (home == 1).sum() == len(few) - 5
    assert set(drawn) == set(range(len(few)))


def test_windows_of_a_smaller_home_are_repeated_evenly(learned):
    data = learned.data
    train = data.indices(TRAIN)
    own = train[learned.home_of_window[train] == 0]
    few = np.concatenate([own[: round(0.6 * len(own))], train[learned.home_of_window[train] == 1]])
    some = replace(data, **{name: getattr(data, name)[few] for name in ("video", "start")})
    count = np.bincount(windows_of_all(replace(learned, data=some)))[: round(0.6 * len(own))]
    halves = [half.mean() for half in np.array_split(count, 2)]
    assert set(count) == {1, 2}
    assert halves[0] == pytest.approx(halves[1], abs=0.1), "early windows are not drawn more often"


def test_bodies_are_learned_from_the_own_home_only(learned):
    windows = windows_from_data(learned, ARCHITECTURE)
    drawn = AugmentationConfig(mirror=0.0)
    statistics = statistics_from_windows(windows, largest_turn_rad(drawn))
    alone = wandering()
    own = windows_from_data(Habitat.of_one_home(alone, Scenes.of(learned.scenes.volumes[0])), ARCHITECTURE)
    by_itself = statistics_from_windows(own, largest_turn_rad(drawn))
    np.testing.assert_allclose(
        statistics.scaling.body_mean[6:],
        by_itself.scaling.body_mean[6:],
        err_msg="bones at rest do not count",
    )
    scene = SceneSampler(learned.scenes, ARCHITECTURE.scene_stride, "cpu")
    batch = draw_batch(windows, scene, statistics, drawn, 64, torch.Generator().manual_seed(0))
    assert 10 < int(batch.bones_known.sum()) < 54, "both homes are drawn"
    assert not batch.bones_keep[~batch.bones_known].any()
    _, bodies, known = sequence_rows(batch, ObjectiveConfig(body_share=0.25))
    assert known.all() and batch.bones_known[bodies].all(), "windows with bones come first"


def test_build_with_other_windows_is_refused(builds, tmp_path):
    own, _ = builds
    slow = write(tmp_path / "slow")
    replace(wandering(), rate_hz=5.0).save(slow / "behavior_data")
    data = wandering()
    scenes = Scenes.load(own / "behavior_data", data.videos)
    with pytest.raises(InputError, match="REC-002"):
        with_other_homes(data, scenes, ReconstructedHome.of_build(own), [slow])


def test_homes_of_tables_are_refused(builds, tmp_path):
    own, _ = builds
    with pytest.raises(InputError, match="trajectories"):
        run(Inputs(own / "behavior_data"), Config(homes=("other",)), tmp_path)


@pytest.mark.slow
def test_one_model_is_trained_in_two_homes(builds, tmp_path):
    own, other = builds
    optimization = replace(
        BehaviorTrainingConfig().optimization, steps=4, goal_steps=2, batch=8, goal_batch=8
    )
    config = Config(export=False, homes=("other",), training=BehaviorTrainingConfig(optimization))
    inputs = Inputs(own / "behavior_data", own / "feature_basis", own / "scene_template", {"other": other})
    (tmp_path / "alone").mkdir()
    run(inputs, config, tmp_path)
    run(inputs, replace(config, homes=()), tmp_path / "alone")
    weights = [(folder / "behavior.safetensors").read_bytes() for folder in (tmp_path, tmp_path / "alone")]
    assert weights[0] != weights[1]
