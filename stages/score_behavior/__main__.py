"""Score one trial of a behaviour method on the test windows, end to end and fed with the truth.

Writes one number per window and score, with the exact list of windows, so that tables can draw intervals over methods,
seeds and episodes. Where there are scripted approaches, also how often the model's animal flees.
"""

from dataclasses import dataclass

from pipeline import cli, progress
from pipeline.errors import InputError
from pipeline.files import arrays
from pipeline.models import behavior
from pipeline.models.behavior import Sampling
from pipeline.models.predictors import Ats
from pipeline.models.scenes import Scenes
from pipeline.models.trajectories import TEST, BehaviorData
from stages.score_behavior import approaches, protocols
from stages.score_behavior.protocols import Effort


@dataclass(frozen=True)
class Config:
    """Settings of the judgement."""

    seed: int = 0
    """Of the samples; the same for every method."""
    samples: int = 16
    """Samples per window, the best of which counts (K)."""
    trials: int = 12
    """Trials of goals (L)."""
    stride: int = 1
    """Goals are judged on every so many test windows."""
    plan_trials: int = 1
    """Trials of paths and bodies, which cost a hundred times more."""
    plan_stride: int = 16
    """Paths and bodies are judged on every so many test windows."""
    approach_samples: int = 4
    """Plans per scripted approach."""


def run(task: cli.Task) -> None:
    """Score one trained model."""
    c: Config = task.config
    model = task.input("behavior_trials")
    architecture = behavior.load(model)[0]
    data = BehaviorData.load(task.input("behavior_data")).with_horizon(architecture.future)
    if not len(data.indices(TEST)):
        raise InputError(
            "BEH-004", "there is no test window", str(task.paths["behavior_data"]), "record a session for the test, 6.4 s or longer"
        )
    ats = Ats.load(model, Scenes.load(task.paths["behavior_data"], data.videos), Sampling(), device=task.device)
    found = protocols.scores(ats, data, architecture.family, Effort(c.samples, c.trials, c.stride, c.plan_trials, c.plan_stride, c.seed))
    folder = task.input("approaches") if task.has("approaches") else None
    if folder and (folder / "approaches.npz").is_file():
        found |= approaches.shares(ats, approaches.read(folder), c.approach_samples, c.seed)
    shown = ("end_to_end/goal_minde_m", "end_to_end/path_minade_m", "truth_fed/path_minade_m")
    progress.log(", ".join(f"{name} {found[name].mean():.3f}" for name in shown if name in found))
    with task.create() as out:
        arrays.save(out / "scores.npz", **found)


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("behavior_data", "behavior_trials"), optional=("approaches",))
