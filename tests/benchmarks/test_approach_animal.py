"""The cat that policies meet in the end, and the windows that its model learns from."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks import approach_animal
from benchmarks.approach_animal import TrueCats
from benchmarks.behavior_builds import slice_sessions
from pipeline.behavior.trajectories import TRAIN, BehaviorData
from stages.slice_behavior.config import Config as SlicingConfig

EYE_M = 1.4
REACH_M = 0.7


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Iterator[BehaviorData]:
    """Windows of half a minute in the first home."""
    folder: Path = tmp_path_factory.mktemp("life")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(approach_animal, "TAKES", 1)
        patch.setattr(approach_animal, "SESSION_S", 40.0)
        motion = approach_animal.simulated_session(*approach_animal.home_of(0, 0))
        slice_sessions([("home0-0", "train", motion)], folder, SlicingConfig.stride)
        yield BehaviorData.load(folder / "behavior_data")


def met(data: BehaviorData, speed_m_s: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Walk up to cats from 2.2 m; return who fled and who was reached before, of those that do not flee yet."""
    chosen = data.indices(TRAIN)[::20]
    context, _ = data.windows(chosen)
    cat = context.world_from_agent[:, -1, :3, 3]
    angle = np.random.default_rng(0).uniform(0, 2 * np.pi, len(cat))
    eyes = cat + np.stack([2.2 * np.sin(angle), EYE_M - cat[:, 1], 2.2 * np.cos(angle)], axis=-1)
    context.observer_world[:] = eyes[:, None]
    cats = TrueCats(data)
    cats.begin(context, np.random.default_rng(1))
    calm = ~cats.fleeing
    fled, reached = np.zeros((2, len(cat)), bool)
    for _ in range(round(10 * seconds)):
        away = (cats.past_world[:, -1] - eyes) * [1.0, 0.0, 1.0]
        distance = np.linalg.norm(away, axis=1, keepdims=True)
        eyes = eyes + away / distance * np.minimum(0.1 * speed_m_s, np.maximum(distance - REACH_M + 0.05, 0))
        cats.step(eyes)
        fled |= cats.fleeing & ~reached
        reached |= (distance[:, 0] < REACH_M) & ~fled
    return fled[calm], reached[calm]


def test_true_cats_flee_from_fast_persons_only(data):
    fled, _ = met(data, 1.2, 6.0)
    assert fled.mean() > 0.8
    fled, reached = met(data, 0.2, 12.0)
    assert fled.mean() < 0.1
    assert reached.mean() > 0.6
    fled, _ = met(data, 0.0, 6.0)
    assert not fled.any()


def test_true_cats_start_where_the_window_ends(data):
    context, _ = data.windows(data.indices(TRAIN)[::20])
    cats = TrueCats(data)
    cats.begin(context, np.random.default_rng(0))
    np.testing.assert_allclose(cats.past_world[:, -1], context.world_from_agent[:, -1, :3, 3], atol=0.02)
    reasons = {cat.reason for cat in cats.cats}
    assert reasons == {"own", "approach", "flee"}, "with what it had in mind"
