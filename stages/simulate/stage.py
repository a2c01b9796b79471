"""The stage: trained models -> one take."""

from pathlib import Path

from pipeline.core import config as configuration
from pipeline.core import devices, progress
from stages.simulate import subgoal_file, takes
from stages.simulate.config import Config
from stages.simulate.inputs import Inputs


def run(inputs: Inputs, config: Config, out: Path, *, device: devices.Device = "cpu") -> None:
    """Make one take. Raises SIM-002, SIM-004, SIM-005, SIM-006, SIM-010, ART-007."""
    subgoals = None
    if inputs.subgoals is not None:
        path = inputs.subgoals
        tables = subgoal_file.tables(configuration.read_table(path), path)
        entries = [
            configuration.from_table(subgoal_file.SubgoalEntry, table, where=str(path)) for table in tables
        ]
        subgoals = subgoal_file.subgoals(entries, path)
    if config.serve:
        take = takes.live(inputs, config, device)
    elif config.recording is not None:
        take = takes.of_recording(inputs, config, config.recording)
    elif subgoals is None and config.places == "none":
        take = takes.of_behavior(inputs, config, device)
    else:
        take = takes.through_subgoals(inputs, subgoals, config, device)
    progress.log(take.summary)
    take.write(out)
