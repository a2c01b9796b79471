"""Film the built-in world: a furnished room with a cat that minds people, as Record3D recordings.

Writes `recordings/` (walk-through, turnaround, sessions, a second phone for one session) and, apart
from them, `truth/`, which only `evaluate` may read. No real animal is needed to run the whole flow.
"""

import dataclasses

import numpy as np

from pipeline import cli, progress
from stages.synthesize_capture import animal, produce, review, room, script


@dataclasses.dataclass(frozen=True)
class Config:
    """What to film."""

    seed: int = 0
    """Decides everything: room, coat, light, behaviour, noise."""
    session_count: int = 6
    """Recordings of the animal's life; the last is the test video."""
    session_s: float = 60.0
    """Length of a session, seconds."""
    test_session_s: float = 120.0
    """Length of the last session, seconds: longer, since a minute holds too few independent lives of 5.6 s to compare by."""
    walkthrough_s: float = 45.0
    """Length of the walk through the empty room, seconds."""
    turnaround_s: float = 20.0
    """Length of the circle around the standing animal, seconds."""
    heldout_of: int = 2
    """Session (from 1) that a second phone films from the other side; 0 = none."""
    record_fps: float = 15.0
    """Frames per second that the phone stores."""
    dim_session: int = 3
    """Session (from 1) filmed in the evening; 0 = none."""
    sideways_session: int = 4
    """Session (from 1) filmed with the phone held sideways; 0 = none."""
    harsh_session: int = 0
    """Session (from 1) in low red sun from one side, overexposed, with another white balance; 0 = none."""
    foreign_sessions: int = 0
    """Sessions more, after the others, each filmed in another home: they fit nowhere and are to be refused."""
    color_height: int = 320
    """Pixels of the stored portrait canvas."""
    color_width: int = 240
    """Pixels of the stored portrait canvas."""
    depth_height: int = 256
    """Pixels of the stored depth."""
    depth_width: int = 192
    """Pixels of the stored depth."""


def run(task: cli.Task) -> None:
    """Build the world, write every recording's script, film them, and keep the truth apart."""
    settings: Config = task.config
    home = room.furnish(np.random.default_rng([settings.seed, 0]))
    creature = animal.grow(np.random.default_rng([settings.seed, 2]))
    scripts = script.scripts(script.Plan(**dataclasses.asdict(settings)), home)
    progress.log(f"world: {len(scripts)} recordings, {sum(len(part.timestamp_s) for part in scripts)} frames")
    with task.create() as folder:
        recordings, truth = folder / "recordings", folder / "truth"
        recordings.mkdir()
        truth.mkdir()
        made = produce.produce(scripts, creature, recordings, truth, workers=task.threads)
        produce.write_world(home, creature, settings.seed, truth)
        review.report_quality(folder, scripts, made)


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config)
