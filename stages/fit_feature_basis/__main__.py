"""Fit the 16 feature channels jointly over the walk-through, the turnaround and the training sessions."""

from dataclasses import dataclass

from pipeline import cli, progress, qa
from pipeline.files.clips import Clip
from pipeline.models.describers import Backend, Describer
from pipeline.models.features import fit_basis
from stages.fit_feature_basis.sampling import sample_descriptors


@dataclass(frozen=True)
class Config:
    """Settings of the feature basis."""

    backend: Backend = "daisy"
    """Descriptor of all features: `daisy` needs no weights, `dinov2` `make extras` and a checkpoint."""
    weights: str = ""
    """Folder of the checkpoint (`facebook/dinov2-small` and its like)."""
    frames_per_recording: int = 16
    """Frames described per recording, spread over its length."""
    stride_px: int = 16
    """Distance between sampled descriptors, colour pixels."""
    whitening: float = 0.5
    """0 keeps the spread of each axis, 1 makes all equal."""


def run(task: cli.Task) -> None:
    """Fit one agent's basis."""
    settings: Config = task.config
    folders = task.per_video("frames", roles=("walkthrough", "turnaround", "session"), splits=("train", "none"))
    clips = [Clip.open(folder) for folder in progress.track(folders.values(), "feature basis: recordings")]
    describer = Describer(settings.backend, settings.weights)
    raw = sample_descriptors(
        clips, describer.open(lambda: task.device), frames_per_clip=settings.frames_per_recording, stride_px=settings.stride_px
    )
    basis = fit_basis(raw, whitening=settings.whitening)
    with task.create() as folder:
        basis.save(folder)
        describer.save(folder)
        qa.write(
            folder,
            good="the 16 axes hold most of the variance",
            bad="less than a third of it: the pictures are noise, or have no texture",
            checks=[
                qa.Check("variance held", 100 * float(basis.explained.sum()), "%", warn=35.0, better="higher"),
                qa.Check("descriptors", float(len(raw)), "", warn=2000, better="higher"),
                qa.Check("recordings", float(len(clips))),
            ],
        )


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("frames",))
