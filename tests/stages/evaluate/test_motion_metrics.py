"""Metrics of physical plausibility on constructed cases."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.baselines.predictors import Samples
from pipeline.behavior.trajectories import TEST, BehaviorData, Context, Future
from pipeline.metrics import bars
from stages.evaluate import physical
from tests.stages.export_simulator import small_world


@dataclass(frozen=True)
class Sunk:
    """Predicts the recorded motion with an offset downwards."""

    future: Future
    depth_m: float

    def sample(self, context: Context, count: int, rng: np.random.Generator) -> Samples:
        lower = np.array([0, self.depth_m, 0])
        path, root = self.future.path_world - lower, self.future.world_from_agent
        return Samples(
            path[:, None, -1], path[:, None], root[:, None, :, :3, :3], self.future.agent_from_bone[:, None]
        )


def test_body_below_the_floor_penetrates(tmp_path: Path) -> None:
    small_world.write_surfaces(tmp_path)
    tracks = {f"v{2 + k:03d}": small_world.trajectory(120, k) for k in range(2)}
    starts, videos = np.array([0, 20, 0, 20], np.int32), np.array([0, 0, 1, 1], np.int32)
    data = BehaviorData(tracks, small_world.rest(), videos, starts, np.array([False, True]), tuple(tracks))
    sunk = Sunk(data.windows(data.indices(TEST))[1], 0.1)
    values = physical.physical_metrics(data, sunk, tmp_path, seed=0).values
    assert set(values) == set(physical.NAMES) and values["behavior/physical_windows"] == 2
    assert (
        values["behavior/recorded/penetration_m"] < 0.003 < 0.01 < values["behavior/ats/penetration_m"] < 0.1
    ), "meters"
    assert (
        values["behavior/ats/non_collision_share"]
        < 0.7
        < 0.95
        < values["behavior/recorded/non_collision_share"]
    )
    nobody = BehaviorData(tracks, small_world.rest(), videos, starts, np.zeros(2, bool), tuple(tracks))
    assert set(physical.physical_metrics(nobody, sunk, tmp_path, seed=0).values.values()) == {None}


def test_plans_without_a_foot_on_the_ground_fail(tmp_path: Path) -> None:
    small_world.write_surfaces(tmp_path)
    lower = 0.05 * np.eye(4)[:, 1:2] @ np.eye(4)[3:]
    walks = [small_world.trajectory(120, seed) for seed in range(2)]
    tracks = {
        f"v{2 + number:03d}": replace(walk, world_from_agent=walk.world_from_agent - lower)
        for number, walk in enumerate(walks)
    }
    starts, videos = np.array([0, 20, 0, 20], np.int32), np.array([0, 0, 1, 1], np.int32)
    tested = np.array([False, True])
    data = BehaviorData(tracks, small_world.rest(), videos, starts, tested, tuple(tracks))
    future = data.windows(data.indices(TEST))[1]
    found = {
        depth_m: physical.physical_metrics(data, Sunk(future, depth_m), tmp_path, seed=0)
        for depth_m in (0.0, -0.3)
    }
    for depth_m, status in ((0.0, "ok"), (-0.3, "warn")):
        assert found[depth_m].values["behavior/recorded/foot_slide_m_s"] is not None
        assert [each.status for each in bars.checks(found[depth_m], "behavior/ats/foot")] == [status]
