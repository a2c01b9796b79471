"""Behavior data and models of benchmarks, made by the stages of the flow; finished models are reused."""

import shutil
from collections.abc import Iterable
from pathlib import Path

from pipeline.core.progress import log
from pipeline.core.videos import Split, Video
from pipeline.data import npz
from stages.read_trajectories.motion import MeasuredMotion
from stages.slice_behavior import stage as slicing
from stages.slice_behavior.config import Config as SlicingConfig
from stages.train_behavior import stage as training
from stages.train_behavior.config import Config as TrainingConfig

TAKES, SESSION_S = 5, 150.0
"""Takes of a simulated session, each from a random start, and its duration: as in `stages.synthesize_capture.lives`."""
WINDOW_STRIDE = 5
"""Frames between windows: adjacent ones are nearly identical, and a window of 6.4 s takes memory."""


def slice_sessions(
    sessions: Iterable[tuple[str, Split, MeasuredMotion]], out: Path, stride: int = WINDOW_STRIDE
) -> None:
    """Write motions by name to `lives` in ``out``, and slice them into its `behavior_data`; replace what is there."""
    videos, tables = [], {}
    for name, split, motion in sessions:
        tables[name] = emptied(out / "lives" / name)
        npz.save(tables[name] / "motion.npz", compress=False, **motion.arrays())
        npz.save(tables[name] / "skin.npz", agent_from_bone_rest=motion.agent_from_bone_rest)
        npz.save(tables[name] / "feature_volume.npz", **vars(motion.volume))
        videos.append(Video(name, f"{name}.npz", "session", split, None))
    log(f"{len(videos)} simulated sessions")
    inputs, config = slicing.Inputs(trajectories=tables), SlicingConfig(stride=stride)
    slicing.run(inputs, config, emptied(out / "behavior_data"), videos=tuple(videos))


def train_model(out: Path, config: TrainingConfig, name: str) -> Path:
    """Train a model on the `behavior_data` of ``out`` unless it has one of this name; return its folder."""
    model = out / name
    if not (model / "behavior.json").is_file():
        training.run(training.Inputs(out / "behavior_data"), config, emptied(model))
    return model


def emptied(folder: Path) -> Path:
    """Return a folder as a new one: without the files of an earlier run."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder
