"""Forecasts of goals, paths and bodies on dog motion capture, with leave-one-clip-out cross-validation.

The stages are those of `agents/dog.toml`: joints are converted to a root and bones, sliced into windows of 0.8 s +
5.6 s, and the behavior model is trained on all clips but one.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.behavior_builds import emptied
from benchmarks.real.forecasts import LocationPriorPath
from benchmarks.real.table import Row
from pipeline.baselines.predictors import Ats, ConstantVelocity, LocationPrior, Samples, StandStill
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import TEST, TRAIN, BehaviorData
from pipeline.core.progress import log
from pipeline.core.videos import Video
from pipeline.data import npz
from pipeline.metrics.scores import SCORES
from stages.read_trajectories import stage as reading
from stages.read_trajectories.config import Config as ReadingConfig
from stages.slice_behavior import stage as slicing
from stages.slice_behavior.config import Config as SlicingConfig
from stages.train_behavior import stage as training
from stages.train_behavior.config import AugmentationConfig, BehaviorOptimizerConfig, BehaviorTrainingConfig
from stages.train_behavior.config import Config as TrainingConfig

SAMPLES = 16
STRIDE = 4
"""frames between evaluated windows"""
METRICS = ("goal_minde_m", "goal_energy_score_m", "path_minade_m", "orientation_minade_rad")
MODEL = TrainingConfig(
    export=False,
    scene="none",
    training=BehaviorTrainingConfig(
        BehaviorOptimizerConfig(steps=260, goal_steps=60), AugmentationConfig(turn=0.0)
    ),
)
"""Steps as in `agents/dog.toml`. No rotation augmentation: without a scene nothing depends on the heading, and two
minutes of motion are too little to learn bodies in all headings."""
MethodScores = dict[str, dict[str, list[float]]]
"""per method and score, one value per window"""
MAX_RELATIVE_TURNING = 2.0
"""Limit of the orientation error, relative to that of standing still."""


def read_clips(recording: Path, folder: Path) -> dict[str, Path]:
    """Convert every clip of an NPZ file of joints to a separate recording."""
    found = {}
    for name, joints in npz.load(recording).items():
        found[name] = folder / name
        if not (found[name] / "motion.npz").is_file():
            found[name].mkdir(parents=True, exist_ok=True)
            npz.save(found[name] / "joints.npz", compress=False, joints=joints)
            reading.run(reading.Inputs(found[name] / "joints.npz"), ReadingConfig(), found[name])
    return found


def evaluate_fold(clip: str, clips: dict[str, Path], folder: Path, config: TrainingConfig) -> MethodScores:
    """Train on all clips but one and return the scores of all methods on the windows of that clip."""
    sliced, model = (emptied(folder / name) for name in ("behavior_data", f"behavior-{config.seed}"))
    videos = tuple(Video(name, name, "session", "test" if name == clip else "train", None) for name in clips)
    slicing.run(slicing.Inputs(trajectories=clips), SlicingConfig(), sliced, videos=videos)
    training.run(training.Inputs(sliced), config, model)
    data = BehaviorData.load(sliced)
    scenes = Scenes.load(sliced, data.videos)
    train = data.windows(data.indices(TRAIN))
    context, future = data.windows(data.indices(TEST)[::STRIDE])
    prior = LocationPriorPath(LocationPrior.fit(*train), data.future)
    methods = {
        "ours": Ats.load(model, scenes, PlanSamplingConfig(avoid_solid=False)),
        "standing still": StandStill.fit(*train),
        "constant velocity": ConstantVelocity.fit(*train),
        "location prior": prior,
    }
    samples_by_method = {
        name: method.sample(context, SAMPLES, np.random.default_rng(config.seed))
        for name, method in methods.items()
    }
    return {
        name: {
            score: SCORES[score](samples, future).tolist() for score in METRICS if predicts(samples, score)
        }
        for name, samples in samples_by_method.items()
    }


def predicts(samples: Samples, score: str) -> bool:
    """Return whether a method predicts the quantity that a score evaluates."""
    needed = {"path_minade_m": samples.path, "orientation_minade_rad": samples.rotation}
    return score not in needed or needed[score] is not None


def row(recording: Path, out: Path, *, seeds: int = 1) -> Row:
    """Evaluate on every clip in turn, and average over all windows and seeds."""
    clips = read_clips(recording, out / "dog" / "trajectories")
    found: MethodScores = {}
    for seed in range(seeds):
        for clip in clips:
            done = out / "dog" / clip / f"figures-{seed}.json"
            if not done.is_file():
                scores = evaluate_fold(clip, clips, done.parent, replace(MODEL, seed=seed))
                done.write_text(json.dumps(scores) + "\n")
            for method, scores in json.loads(done.read_text()).items():
                log(
                    f"{clip}, {method}: { ({name: round(float(np.mean(v)), 3) for name, v in scores.items()}) }"
                )
                for name, values in scores.items():
                    found.setdefault(method, {}).setdefault(name, []).extend(values)
    mean = {
        method: {name: float(np.mean(values)) for name, values in scores.items()}
        for method, scores in found.items()
    }
    ours, baselines = mean["ours"], [scores for method, scores in mean.items() if method != "ours"]
    beats_baselines = all(
        ours[name] < other[name] for other in baselines for name in ("goal_minde_m", "path_minade_m")
    )
    still = mean["standing still"]["orientation_minade_rad"]
    turning_ok = ours["orientation_minade_rad"] < MAX_RELATIVE_TURNING * still
    cells = {
        method: " / ".join(f"{scores[name]:.3f}" if name in scores else "-" for name in METRICS)
        for method, scores in mean.items()
    }
    return Row(
        "goals, paths and bodies",
        f"dog motion capture, {len(clips)} clips, each held out once",
        f"goal, m; its energy score, m; path, m; turning, rad (best of {SAMPLES})",
        cells.pop("ours") + (" (one seed)" if seeds == 1 else f" (mean of {seeds} seeds)"),
        cells,
        {},
        "goal and path better than all baselines; turning below twice that of standing still",
        bool(beats_baselines and turning_ok),
        {"means": mean, "windows": len(found["ours"]["goal_minde_m"]) // seeds},
    )
