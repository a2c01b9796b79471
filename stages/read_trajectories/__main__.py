"""Read one table of an animal's motion, so that behaviour can be learned without recordings.

Takes a CSV table (columns id, time, x, y, z, heading; optionally observer_x, observer_y, observer_z), a folder with
`trajectory.csv` and `obstacles.csv` (occupied cells: x, z, optionally bottom, top), an NPZ file of joint positions
([frame joint 3], one array per clip), or a built-in life. Metres, seconds, radians, +y up, heading about +y from +z.
"""

from dataclasses import dataclass

from pipeline import cli, progress, qa
from pipeline.files import arrays
from stages.read_trajectories import pictures
from stages.read_trajectories.captured import Skeleton
from stages.read_trajectories.reading import Reading, read


@dataclass(frozen=True)
class Config:
    """How tables are to be understood."""

    rate_hz: float = 60.0
    """Frames per second of joint positions."""
    root_joint: int = 0
    """Joint at the pelvis: where the animal is."""
    front_joint: int = 3
    """Joint that lies ahead of it: neck or shoulders."""
    cell_m: float = 0.1
    """Side of the obstacle map's cells in metres."""
    obstacle_top_m: float = 1.0
    """Height of obstacles of which the map does not say it."""


def run(task: cli.Task) -> None:
    """Read one recording."""
    c: Config = task.config
    skeleton = Skeleton(c.rate_hz, c.root_joint, c.front_joint)
    life = read(task.input("recording"), Reading(skeleton, c.cell_m, c.obstacle_top_m))
    progress.log(f"{len(life.timestamp_s)} frames, {life.agent_from_bone.shape[1]} bones")
    with task.create() as folder:
        arrays.save(folder / "motion.npz", **life.motion())
        arrays.save(folder / "skin.npz", agent_from_bone_rest=life.agent_from_bone_rest)
        arrays.save(folder / "feature_volume.npz", compress=True, **vars(life.volume))
        qa.write(
            folder,
            good="ways that go round obstacles, at the speeds of an animal",
            bad="jumps, or ways through obstacles: wrong units, axes or origin",
            checks=pictures.checks(life),
            pictures=pictures.pictures(life),
        )


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("recording",))
