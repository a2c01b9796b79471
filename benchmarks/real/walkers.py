"""Pedestrian forecasting on ETH/UCY with leave-one-scene-out cross-validation and the stages of the flow.

The held-out scene is used neither for training nor for tuning. Recordings are converted to tables
(`crowds.Crowd.table`), `read_trajectories`, `slice_behavior` and `train_behavior` run as in any build, and the
behavior model draws 20 independent samples for every window of the protocol.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from benchmarks.behavior_builds import emptied, train_model
from benchmarks.real.crowds import FUTURE, PAST, STEP_S, Crowd, Walk
from benchmarks.real.forecasts import TURN_STD_RAD, ConstantVelocityPath, LocationPriorPath, score_forecasts
from benchmarks.real.table import Row
from pipeline.baselines.predictors import Ats, LocationPrior, Samples
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import TEST, TRAIN, BehaviorData, Context
from pipeline.core.progress import log
from pipeline.core.videos import Video
from stages.read_trajectories import stage as reading
from stages.read_trajectories.config import Config as ReadingConfig
from stages.slice_behavior import stage as slicing
from stages.slice_behavior.config import Config as SlicingConfig
from stages.train_behavior.config import (
    AugmentationConfig,
    BehaviorOptimizerConfig,
    BehaviorTrainingConfig,
    ObjectiveConfig,
)
from stages.train_behavior.config import Config as TrainingConfig

SCENES = ("eth", "hotel", "univ", "zara1", "zara2")
SAMPLES = 20
NOISY = "constant velocity, 25 deg noise"
METHODS = ("truth", "standing still", "constant velocity", NOISY, "location prior")
METRICS = ("ade_m", "fde_m", "energy_m", "collides")
TARGET_M = (0.28, 0.56)
PUBLISHED = {
    "Trajectron++, corrected": "0.32 / 0.55",
    "MoFlow": "0.21 / 0.33",
    "SocialVAE with clustering": "0.21 / 0.33",
}
"""ADE / FDE of the best of 20, as published; the last one clusters more samples to 20."""
MODEL = TrainingConfig(
    horizon_s=FUTURE * STEP_S,
    export=False,
    scene="none",
    ensemble_size=1,
    unet_width=8,
    training=BehaviorTrainingConfig(
        BehaviorOptimizerConfig(steps=1800, goal_steps=1200, batch=128, goal_batch=256),
        AugmentationConfig(turn=0.0, past=0.02, posture_offset=0.0),
        ObjectiveConfig(code_dropout=0.0, goal_draws=4, earlier_share=0.3, path_share=1.0, body_share=0.0),
    ),
)
"""The behavior model without a map; with two orders of magnitude more data than of one animal, a single network and
little noise on the past (1.3 cm) suffice. Chosen on the validation splits of the training scenes."""
SAMPLING = PlanSamplingConfig(
    method="ddpm_large",
    goal_steps=20,
    sequence_steps=1,
    guidance=1.0,
    path_noise_std=0.0,
    avoid_solid=False,
    max_path_draws=1,
)
"""Goals are sampled with the larger variance of DDPM, since that of the posterior underestimates their spread; a path is
the mean given its goal, since noise only adds sway. See `docs/real_benchmark.md`."""
WINDOWS_AT_ONCE = 512
MAX_WINDOWS = 2000
"""Maximal number of evaluated windows per scene, evenly sampled."""


@dataclass(frozen=True)
class ForecastWindow:
    """A window to forecast."""

    recording: str
    walk: Walk
    number: int
    """index in the behavior data"""
    accompanied: bool
    """whether others are present throughout; the protocol of SGAN counts only these"""


@dataclass(frozen=True)
class Fold:
    """A cross-validation fold: the held-out scene and the training data."""

    data: BehaviorData
    scenes: Scenes
    crowds: dict[str, Crowd]
    """the held-out recordings, by name"""

    def forecast_windows(self) -> list[ForecastWindow]:
        """Return all windows of the held-out recordings."""
        found = []
        number = self.data.indices(TEST)
        for name, crowd in self.crowds.items():
            mine = number[self.data.video[number] == self.data.videos.index(name)]
            walks = crowd.walks()
            assert len(mine) == len(walks), (name, len(mine), len(walks))
            accompanied = crowd.accompanied(walks)
            found += [
                ForecastWindow(name, walk, int(each), bool(many))
                for walk, each, many in zip(walks, mine, accompanied, strict=True)
            ]
        return found


def read_recording(crowd: Crowd, folder: Path) -> Path:
    """Run `read_trajectories` on a recording; cached."""
    if not (folder / "motion.npz").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        crowd.table(folder / "table.csv")
        reading.run(reading.Inputs(folder / "table.csv"), ReadingConfig(), folder)
    return folder


def prepare_fold(train: dict[str, Crowd], test: dict[str, Crowd], reads: Path, folder: Path) -> Fold:
    """Run `read_trajectories` (into ``reads``, which folds share) and `slice_behavior` on recordings."""
    tables = {name: read_recording(crowd, reads / name) for name, crowd in (train | test).items()}
    videos = [
        Video(name, f"{name}.csv", "session", "test" if name in test else "train", None) for name in tables
    ]
    sliced = folder / "behavior_data"
    if not (sliced / "qa.json").is_file():
        config = SlicingConfig(smooth_s=0.0, past_s=PAST * STEP_S, rate_hz=1 / STEP_S)
        slicing.run(slicing.Inputs(trajectories=tables), config, emptied(sliced), videos=tuple(videos))
    data = BehaviorData.load(sliced)
    return Fold(data.with_horizon(FUTURE), Scenes.load(sliced, data.videos), test)


def forecast(fold: Fold, model: Path, context: Context, rng: np.random.Generator) -> Samples:
    """Draw independent samples, without selection."""
    ats = Ats.load(model, fold.scenes, SAMPLING)
    return ats.paths(context, SAMPLES, rng, at_once=WINDOWS_AT_ONCE)


def others_of(fold: Fold, windows: list[ForecastWindow]) -> list[Float[np.ndarray, "frame other 2"]]:
    """Return the true future positions of all others, per window."""
    found = []
    for window in windows:
        begin = window.walk.start + PAST
        positions = fold.crowds[window.recording].position[begin : begin + FUTURE]
        other = np.arange(positions.shape[1]) != window.walk.person
        found.append(positions[:, other & np.isfinite(positions[..., 0]).any(0)])
    return found


def baselines(fold: Fold) -> dict[str, ConstantVelocityPath | LocationPriorPath]:
    """Return the baselines, fitted to the same training windows."""
    train = fold.data.indices(TRAIN)
    prior = LocationPrior.fit(*fold.data.windows(train), cell_m=0.2)
    return {
        "standing still": ConstantVelocityPath(FUTURE, speed_factor=0.0),
        "constant velocity": ConstantVelocityPath(FUTURE),
        NOISY: ConstantVelocityPath(FUTURE, TURN_STD_RAD),
        "location prior": LocationPriorPath(prior, FUTURE),
    }


def crowds(folder: Path) -> dict[str, Crowd]:
    """Read the recordings of a folder by their names."""
    return {path.stem: Crowd.read(path) for path in sorted(folder.glob("*.txt"))}


def evaluate_scene(scene: Path, folder: Path, seeds: int) -> dict[str, dict[str, float]]:
    """Return the means of all methods over the windows of a held-out scene; ours per seed as `ours 0`.

    ``scene`` contains `train/` and `test/`; results are cached in ``folder``. Names that end in `, all` include
    windows of a single person.
    """
    done = folder / "figures.json"
    found = json.loads(done.read_text()) if done.is_file() else {}
    seed_names = [f"ours {seed}" for seed in range(seeds)]
    if not set(found) >= set(seed_names):
        fold = prepare_fold(
            crowds(scene / "train"), crowds(scene / "test"), folder.parent / "trajectories", folder
        )
        windows = fold.forecast_windows()
        selected = windows[:: -(-len(windows) // MAX_WINDOWS)]
        accompanied = np.array([window.accompanied for window in selected])
        context, future = fold.data.windows(np.array([window.number for window in selected]))
        others = others_of(fold, selected)

        def record(name: str, samples: Samples) -> None:
            scores = score_forecasts(samples, future, others)
            found[name] = scores.means(accompanied)
            found[f"{name}, all"] = scores.means(np.ones_like(accompanied))
            log(f"{scene.name}, {name}: {found[name]}")

        record(
            "truth", Samples(*(np.stack([true, true], 1) for true in (future.goal_world, future.path_world)))
        )
        for name, method in baselines(fold).items():
            record(name, method.sample(context, SAMPLES, np.random.default_rng(0)))
        for seed, name in enumerate(seed_names):
            if name not in found:
                model = train_model(folder, replace(MODEL, seed=seed), f"behavior-{seed}")
                record(name, forecast(fold, model, context, np.random.default_rng(seed)))
        count = sum(window.accompanied for window in windows)
        found["windows"] = {"judged": int(accompanied.sum()), "accompanied": count, "all": len(windows)}
        done.write_text(json.dumps(found, indent=1) + "\n")
    return found


def row(data: Path, out: Path, *, seeds: int = 1) -> Row:
    """Evaluate on all scenes, each held out once."""
    scenes = {name: evaluate_scene(data / name, out / "eth_ucy" / name, seeds) for name in SCENES}
    own = [f"ours {seed}" for seed in range(seeds)]
    methods = [*METHODS, *(f"{name}, all" for name in ("ours 0", NOISY))]
    mean = {
        method: {
            figure: float(np.mean([scenes[scene][method][figure] for scene in SCENES])) for figure in METRICS
        }
        for method in [*own, *methods]
    }
    ours = {figure: [mean[name][figure] for name in own] for figure in METRICS}
    best = (float(np.mean(ours["ade_m"])), float(np.mean(ours["fde_m"])))
    cells = [f"{np.mean(values):.2f}" for values in ours.values()]
    seed_std = [f"{np.std(values, ddof=1):.3f}" for values in ours.values()] if seeds > 1 else []
    text = " / ".join(cells) + (
        f" (std over {seeds} seeds {' / '.join(seed_std)})" if seed_std else " (one seed)"
    )
    return Row(
        "goals and paths",
        "ETH/UCY, one scene left out, 8 -> 12 steps of 0.4 s",
        "ADE / FDE of 20, m; energy score, m; colliding samples",
        text,
        {name: " / ".join(f"{mean[name][figure]:.2f}" for figure in METRICS) for name in methods},
        PUBLISHED,
        f"<= {TARGET_M[0]} / {TARGET_M[1]}",
        bool(best[0] <= TARGET_M[0] and best[1] <= TARGET_M[1]),
        {"scenes": scenes, "means": mean},
    )
