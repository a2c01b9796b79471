"""Reading of the scores and losses of every trial."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.behavior.trajectories import FUTURE, PAST
from pipeline.data import npz


@dataclass(frozen=True)
class MethodScores:
    """The scores of one method."""

    goal_window: Int[np.ndarray, "goal_window 2"]
    """recording and first frame of the windows that goals are scored on"""
    plan_window: Int[np.ndarray, "plan_window 2"]
    """the same for paths and bodies"""
    values: dict[str, Float[np.ndarray, "_ _"]]
    """[seed window] of `<protocol>/<score>`, `recorded/solid`; `flees/<condition>`, which is per approach"""
    past: int = PAST
    future: int = FUTURE
    """known and predicted frames of a window"""
    samples: int = 16
    """samples per window (K), the best of which counts"""

    def windows_of(self, name: str) -> Int[np.ndarray, "window 2"]:
        """Return the windows that a score belongs to; every approach is an episode of its own."""
        if name.startswith("flees/"):
            count = self.values[name].shape[1]
            return np.stack([np.arange(count), np.zeros(count, int)], axis=1)
        return self.goal_window if name.split("/")[1].startswith("goal") else self.plan_window


def stacked(folders: Sequence[Path]) -> MethodScores:
    """Read the trials of one method, which differ in their seed. Raises InputError ART-010 when damaged."""
    read = [npz.load(folder / "scores.npz") for folder in folders]
    names = [name for name in read[0] if "/" in name]
    return MethodScores(
        read[0]["goal_window"],
        read[0]["plan_window"],
        {name: np.stack([each[name] for each in read]) for name in names},
        *(int(number) for number in (*read[0]["window_frames"], read[0]["samples"])),
    )


def curves(folders: Sequence[Path]) -> dict[str, Float[np.ndarray, "seed step"]]:
    """Read the losses at every step of the trials of one method."""
    read = [npz.load(folder / "losses.npz") for folder in folders]
    return {name.removeprefix("loss/"): np.stack([each[name] for each in read]) for name in read[0]}
