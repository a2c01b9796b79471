"""Training windows of several homes of one animal, with features in the basis of its own build.

Every build has bones of its own, so that bodies are trained on the animal's own build alone.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Int

from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import TRAIN, BehaviorData, Trajectory
from pipeline.core.errors import InputError
from pipeline.environments.homes import Habitat, together
from pipeline.environments.other_home import ReconstructedHome, perceived


def windows_of_all(homes: Habitat) -> Int[np.ndarray, "window"]:
    """Return the training windows of all homes, evenly repeated so that all homes have as many."""
    index = homes.data.indices(TRAIN)
    each = [index[homes.home_of_window[index] == number] for number in range(homes.home_of_video.max() + 1)]
    most = max(len(mine) for mine in each)
    return np.concatenate([mine[np.arange(most) * len(mine) // most] for mine in each if len(mine)])


def with_other_homes(
    data: BehaviorData, scenes: Scenes, own: ReconstructedHome | None, others: Sequence[Path]
) -> Habitat:
    """Add the training windows of ``others``, builds of the same animal, to those of its own build, home 0.

    Raises REC-002 for another rate or past, and the errors of `pipeline.environments.other_home`.
    """
    if not others:
        return Habitat.of_one_home(data, scenes)
    assert own is not None, "further homes are compared with the animal's own"
    habitats = [Habitat.of_one_home(data, scenes)]
    for build in others:
        home = perceived(own, ReconstructedHome.of_build(build))
        habitats.append(Habitat.of_one_home(_training_windows(build, data), home.scenes()))
    return together(habitats)


def _training_windows(build: Path, own: BehaviorData) -> BehaviorData:
    """Return the training windows of another build, with the bones of ``own`` at rest."""
    data = BehaviorData.load(build / "behavior_data")
    if (data.rate_hz, data.past) != (own.rate_hz, own.past):
        what = f"{data.past} known frames at {data.rate_hz:g} Hz, here {own.past} at {own.rate_hz:g}"
        raise InputError("REC-002", what, str(build), "give both builds the same [slice_behavior]")
    data = data.with_horizon(own.future)
    some = data.indices(TRAIN)
    return replace(
        data,
        trajectories={name: _at_rest(track, own) for name, track in data.trajectories.items()},
        agent_from_bone_rest=own.agent_from_bone_rest,
        **{name: getattr(data, name)[some] for name in ("video", "start")},
    )


def _at_rest(track: Trajectory, own: BehaviorData) -> Trajectory:
    shape = (len(track.timestamp_s), *own.agent_from_bone_rest.shape)
    return replace(track, agent_from_bone=np.broadcast_to(own.agent_from_bone_rest, shape))
