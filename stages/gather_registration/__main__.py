"""Gather the registrations of all sessions: their poses, and a summary of what was registered and what was refused,
and why.
"""

import json
from dataclasses import dataclass

from pipeline import cli, progress, qa
from pipeline.errors import InputError
from pipeline.files import arrays
from stages.gather_registration import gather


@dataclass(frozen=True)
class Config:
    """What the rest of the flow needs."""

    least_registered: int = 1
    """Sessions that must be registered for the flow to go on."""


def run(task: cli.Task) -> None:
    """Copy the poses of registered recordings and write the summary. Raises InputError REG-001 when too few are
    registered.
    """
    outcomes, names = [], {video.id: video.file for video in task.videos}
    for video, folder in task.per_video("video_poses").items():
        status = json.loads((folder / "status.json").read_text())
        poses = arrays.load(folder / "poses.npz") if status["registered"] else None
        outcomes.append(gather.Outcome(video, status, poses, names[video]))
    summary = gather.summarise(outcomes)
    if summary["registered"] < task.config.least_registered:
        reasons = "; ".join(outcome.told for outcome in outcomes if outcome.poses is None)
        raise InputError(
            "REG-001",
            f"{summary['registered']} of {summary['total']} sessions fit the walk-through ({reasons})",
            str(task.out),
            "record a walk-through that shows the whole room, or sessions in that room",
        )
    for outcome in outcomes:
        if outcome.poses is None:
            progress.log(f"refused {outcome.told}")
    with task.create() as folder:
        for outcome in outcomes:
            if outcome.poses is not None:
                (folder / outcome.video).mkdir()
                arrays.save(folder / outcome.video / "poses.npz", **outcome.poses)
        (folder / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
        qa.write(
            folder, good="all recordings are registered and their paths share one room",
            bad="recordings are refused, or a path lies apart from the others",
            checks=gather.checks(outcomes),
            pictures=[qa.Picture("paths", gather.paths(outcomes), "From above: phones thin, animals thick.")],
        )  # fmt: skip


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("video_poses",))
