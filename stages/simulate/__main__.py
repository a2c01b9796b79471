"""Run the behaviour model without a page, or let the animal travel through sub-goals for minutes; write the take.

With `--behavior`: beside a scripted observer; writes `take.npz` and `take.csv`. In Python: `Simulator.reset(seed)` and
`Simulator.step(observer)` of `pipeline.models.simulator`. With `--serve`: live in a browser, computed here; kept too.
With `--longterm` and `--subgoals FILE` (see `stages.simulate.subgoal_file`) or `--places`, or a recording that `--config`
names: writes `take.npz` at 30 fps, `take.glb`, `take.json` and `frames/`. Both in the space of `--behavior-data`.
"""

from dataclasses import dataclass, field

from pipeline import cli, config, progress
from pipeline.models import behavior
from pipeline.models.motion_optimization import Settings
from pipeline.models.simulator import Chaining
from stages.simulate import subgoal_file, takes
from stages.simulate.observers import Script


@dataclass(frozen=True)
class Config:
    """Settings of a take."""

    seconds: float = 30.0
    """Length of a take of the behaviour model."""
    observer: Script = "approach"
    """What the observer does."""
    observer_speed_m_s: float = 1.0
    """How fast the observer walks."""
    chaining: Chaining = field(default_factory=Chaining)
    """How plans follow each other."""
    sampling: behavior.Sampling = field(default_factory=behavior.Sampling)
    """How plans are drawn; `guidance` is the interactivity."""
    places: takes.Places = "none"
    """Sub-goals that no file gives: drawn from where the animal has been, or the behaviour model's goals one after the other;
    none: a take of the behaviour model."""
    place_count: int = 20
    """How many of them."""
    optimise: bool = True
    """Make the motion physical; a take of the behaviour model only where `--longterm` and `--reconstruction` are given."""
    optimisation: Settings = field(default_factory=Settings)
    """Weights and length of that."""
    recording: str | None = None
    """Take the reconstructed motion of this session, its longest stretch, instead."""
    pictures_per_s: float = 10.0
    """Pictures per second of long-term motion; 0 = none."""
    seed: int = 0
    """Seed of the beginning and of all noise."""
    serve: bool = False
    """Show the animal live, on this machine alone, until interrupted; needs `--simulator` and viser (`make extras`)."""
    port: int = 8080
    """Where it is shown."""


def run(task: cli.Task) -> None:
    """Make one take."""
    c: Config = task.config
    given = {name: task.input(name) for name in ("behavior", "behavior_data", "simulator", "longterm", "reconstruction") if task.has(name)}
    written = None
    if task.has("subgoals"):
        path = task.input("subgoals")
        tables = subgoal_file.tables(config.read_table(path), path)
        written = subgoal_file.subgoals([config.from_table(subgoal_file.Written, each, where=str(path)) for each in tables], path)
    if c.serve:
        take = takes.live(given, c, task.device)
    elif c.recording is not None:
        take = takes.of_recording(given, c)
    elif written is None and c.places == "none":
        take = takes.of_behavior(given, c, task.device)
    else:
        take = takes.through_subgoals(given, written, c, task.device)
    progress.log(take.said)
    with task.create() as folder:
        take.write(folder)


if __name__ == "__main__":
    optional = ("behavior", "simulator", "longterm", "reconstruction", "subgoals")
    cli.enter(
        __doc__, run, config=Config, reads=("behavior_data",), optional=optional, options=("serve", "port", "seed", "seconds", "places")
    )
