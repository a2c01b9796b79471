"""What reconstruction costs behaviour: one model trained on reconstructed motion and one on the true motion
of the same sessions.

    python -m benchmarks.behavior_gap cat --seeds 3

Needs a finished `behavior_data` of the built-in capture. Recordings, split, scene and training are the same;
each model is judged on its own kind of motion of the test session, for true bones and reconstructed ones are
not the same bones. The true world is brought into ours by one rigid motion, fitted on the walk-through's
cameras alone.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.planning import TorchNetworks
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import TEST, BehaviorData
from pipeline.core import config
from pipeline.data import npz
from pipeline.data.clips import read_source_index
from pipeline.data.templates import SceneCameras
from pipeline.metrics.pose_errors import constant_between
from pipeline.rivals.predictors import Ats
from pipeline.rivals.samplers import sampler_of
from stages.score_behavior.config import Config as ScoringConfig
from stages.score_behavior.protocols import scores
from stages.slice_behavior.gridding import ReconstructedMotion, trajectory_from_motion
from stages.slice_behavior.windows import slice_windows
from stages.train_behavior.config import Config
from stages.train_behavior.outcome import architecture_for
from stages.train_behavior.training import train


def ours_from_truth(build: Path, walkthrough: str) -> Float[np.ndarray, "4 4"]:
    """Return the rigid motion from the true world to ours."""
    cameras = SceneCameras.open(build / "scene_template")
    source = read_source_index(build / "frames" / walkthrough)
    true = npz.load(build / "synthetic_capture/truth/walkthrough.npz", ("world_from_camera",))[
        "world_from_camera"
    ][source]
    kept = cameras.registered
    return constant_between(cameras.world_from_camera[kept], true[kept])


def true_data(build: Path, ours: BehaviorData, videos: list[dict]) -> BehaviorData:
    """Return the true motion of the recordings of ``ours``, in our world, at the same times."""
    walkthrough = next(video["id"] for video in videos if video["role"] == "walkthrough")
    world_from_true = ours_from_truth(build, walkthrough)
    trajectories = {}
    for video in (video for video in videos if video["id"] in ours.videos):
        table = npz.load(build / "synthetic_capture/truth" / f"{Path(video['file']).stem}.npz")
        agent, camera = (world_from_true @ table[name] for name in ("world_from_agent", "world_from_camera"))
        motion = ReconstructedMotion(
            table["timestamp_s"],
            camera,
            agent,
            table["agent_from_bone"].astype(float),
            np.ones(len(agent)),
            np.ones(len(agent), bool),
        )
        known = trajectory_from_motion(motion, min_confidence=0.0, max_gap_s=0.6, smooth_s=0.0)
        mine = ours.trajectories[video["id"]]
        shared = np.isclose(known.timestamp_s[:, None], mine.timestamp_s[mine.valid], atol=0.02).any(1)
        trajectories[video["id"]] = replace(known, valid=known.valid & shared)
    rest = np.tile(np.eye(4, dtype=np.float32), (table["agent_from_bone"].shape[1], 1, 1))
    rest[:, :3, 3] = np.median(
        np.concatenate([t.agent_from_bone[..., :3, 3] for t in trajectories.values()]), axis=0
    )
    test = frozenset(video["id"] for video in videos if video["split"] == "test")
    return slice_windows(trajectories, test, rest, stride=1)


def trained(data: BehaviorData, scenes: Scenes, settings: Config) -> Ats:
    """Train a model on the data."""
    architecture = architecture_for(settings, data, scenes)
    fitted = train(
        data, scenes, architecture, Schedule(course=settings.schedule), settings.training, seed=settings.seed
    )
    sampler = sampler_of(
        architecture, TorchNetworks(fitted.nets), Schedule(course=settings.schedule), fitted.scaling
    )
    return Ats(sampler, scenes, data.agent_from_bone_rest, architecture.ego, PlanSamplingConfig())


def judged(data: BehaviorData, scenes: Scenes, settings: Config, effort: ScoringConfig) -> dict[str, float]:
    """Train on the data and return the mean scores on its test windows."""
    found = scores(trained(data, scenes, settings), data, settings.family, effort)
    return {name: float(value.mean()) for name, value in found.items() if "/" in name}


def main() -> None:
    """Train and print both, seed by seed, and their ratio."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("agent")
    parser.add_argument("--build", type=Path, default=Path("build"))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument(
        "--settings", type=Path, help="table of train_behavior, JSON or TOML (default: its defaults)"
    )
    given = parser.parse_args()
    torch.set_num_threads(1)
    build = given.build / given.agent
    videos = json.loads((build / "plan/videos.json").read_text())
    ours = BehaviorData.load(build / "behavior_data")
    scenes, truth = Scenes.load(build / "behavior_data", ours.videos), true_data(build, ours, videos)
    settings = config.load(Config, given.settings) if given.settings else Config()
    pairs = {"reconstructed": ours, "true": truth}
    for name, data in pairs.items():
        print(f"{name}: {len(data.start)} windows, {len(data.indices(TEST))} of them test windows")
    found: dict[str, list[dict[str, float]]] = {name: [] for name in pairs}
    for seed in range(given.seeds):
        for name, data in pairs.items():
            effort = ScoringConfig(samples=16, trials=4, stride=2, plan_stride=8, seed=0)
            found[name].append(judged(data, scenes, replace(settings, seed=seed), effort))
            print(
                f"seed {seed}, {name}: goal minDE {found[name][-1]['end_to_end/goal_minde_m']:.3f} m",
                flush=True,
            )
    for score in found["true"][0]:
        ours, true = (float(np.mean([each[score] for each in found[name]])) for name in pairs)
        print(
            f"{score:40s} reconstructed {ours:.3f}  true {true:.3f}"
            + (f"  ratio {ours / true:.2f}" if true else "")
        )


if __name__ == "__main__":
    main()
