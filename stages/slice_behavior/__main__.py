"""Turn reconstructed motion into trajectories on a 10 Hz grid and windows of 6.4 s for the behaviour model.

A window is 0.8 s of past and 5.6 s of future, all of it valid; the split is by recording. Motion comes from the
reconstruction or from tables. Writes also the scenes' feature volumes, with the voxels in which the animal may be.
"""

from dataclasses import dataclass

from pipeline import cli, progress, qa
from pipeline.errors import InputError
from pipeline.models.trajectories import TRAIN
from stages.slice_behavior import pictures, reading, writing
from stages.slice_behavior.gridding import trajectory_from_motion
from stages.slice_behavior.windows import slice_windows


@dataclass(frozen=True)
class Config:
    """Settings of slicing."""

    min_confidence: float = 0.3
    """Frames whose motion is less trusted than this (0..1) count as missing."""
    max_gap_s: float = 0.6
    """Longest hole in seconds that interpolation may bridge."""
    smooth_s: float = 0.08
    """Standard deviation in seconds of the smoothing of the agent's root; 0 for none."""
    stride: int = 1
    """Frames between starts of training windows."""
    reach_voxels: int = 2
    """Voxels around visited places in which the animal may be, whatever the map says."""


def run(task: cli.Task) -> None:
    """Slice all sessions, reconstructed or read from tables."""
    settings: Config = task.config
    sessions = {video.id: video for video in task.videos if video.role == "session"}
    if not sessions:
        raise InputError("ART-004", "which recordings?", task.stage, "give --videos build/<agent>/plan/videos.json")
    if task.has("trajectories"):
        source = reading.read_tables(task.per_video("trajectories"))
    else:
        source = reading.read_reconstruction(task.input("reconstruction"), list(sessions))
    gaps = {"min_confidence": settings.min_confidence, "max_gap_s": settings.max_gap_s, "smooth_s": settings.smooth_s}
    trajectories = {id: trajectory_from_motion(motion, **gaps) for id, motion in source.motions.items()}
    test = frozenset(id for id in trajectories if sessions[id].split == "test")
    data = slice_windows(trajectories, test, source.agent_from_bone_rest, stride=settings.stride)
    if not len(data.indices(TRAIN)):
        remedy = "record longer sessions in which the animal stays in view, lower min_confidence, or raise max_gap_s where rows are further apart"
        raise InputError("BEH-001", "no 6.4 s of uninterrupted motion to learn from", source.where, remedy)
    progress.log(f"{len(data.indices(TRAIN))} training windows, {len(data.start) - len(data.indices(TRAIN))} test windows")
    seen = {id: trajectory for id, trajectory in trajectories.items() if id not in test}
    with task.create() as out:
        data.save(out)
        writing.write_volumes(out, source.volumes, seen, tuple(source.motions), reach_voxels=settings.reach_voxels)
        qa.write(
            out,
            good="hundreds of windows, an animal that covers the room, and an observer at many distances",
            bad="long invalid stretches, or an animal that never moves",
            checks=pictures.checks(data),
            pictures=pictures.pictures(data, source.volumes[0], test),
        )


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, optional=("reconstruction", "trajectories"))
