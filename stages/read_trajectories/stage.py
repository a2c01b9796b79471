"""The stage: one table of motion -> motion, skin and scene as `reconstruct` writes them."""

from dataclasses import dataclass
from pathlib import Path

from pipeline.core import progress
from pipeline.data import npz, qa
from stages.read_trajectories import pictures
from stages.read_trajectories.config import Config
from stages.read_trajectories.reading import read


@dataclass(frozen=True)
class Inputs:
    """What the stage reads."""

    recording: Path
    """CSV table, folder with `trajectory.csv` and `obstacles.csv`, or NPZ file."""


def run(inputs: Inputs, config: Config, out: Path) -> None:
    """Read one recording. Raises TRJ-001, TRJ-002."""
    motion = read(inputs.recording, config)
    progress.log(f"{len(motion.timestamp_s)} frames, {motion.agent_from_bone.shape[1]} bones")
    npz.save(out / "motion.npz", compress=False, **motion.arrays())
    npz.save(out / "skin.npz", agent_from_bone_rest=motion.agent_from_bone_rest)
    npz.save(out / "feature_volume.npz", compress=True, **vars(motion.volume))
    qa.write(
        out,
        good="tracks that go round obstacles, at the speeds of an animal",
        bad="jumps, or tracks through obstacles: wrong units, axes or origin",
        checks=pictures.checks(motion),
        pictures=pictures.pictures(motion),
    )
