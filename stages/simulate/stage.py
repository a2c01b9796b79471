"""The stage: trained models -> one take."""

from pathlib import Path

from pipeline.core import devices, progress
from pipeline.core.errors import InputError
from stages.simulate import subgoal_file, takes
from stages.simulate.config import Config
from stages.simulate.inputs import Inputs


def run(inputs: Inputs, config: Config, out: Path, *, device: devices.Device = "cpu") -> None:
    """Make one take, or one of each animal of a home. Raises SIM-002, SIM-004, SIM-006, SIM-010, SIM-011,
    SIM-013, ART-003, ART-007.
    """
    subgoals = None if inputs.subgoals is None else subgoal_file.read(inputs.subgoals)
    of_behavior = not config.serve and subgoals is None
    if inputs.home is not None and (not of_behavior or config.places != "none" or config.replayed):
        what = "sub-goals, the live view and recorded clips have the animal's own home"
        raise InputError("SIM-011", what, str(inputs.home), "leave them out, or the other home")
    if inputs.animals is None and (config.absent or config.replayed):
        what = "animals can be left out or replayed in a home of several alone"
        raise InputError("SIM-013", what, ", ".join(config.absent + config.replayed), "leave the option out")
    if inputs.animals is not None:
        take = takes.of_home(inputs, inputs.animals, config, device)
    elif config.serve:
        take = takes.live(inputs, config, device)
    elif of_behavior and config.places == "none":
        take = takes.of_behavior(inputs, config, device)
    else:
        take = takes.through_subgoals(inputs, subgoals, config, device)
    progress.log(take.summary)
    take.write(out)
