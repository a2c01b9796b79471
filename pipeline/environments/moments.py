"""Recorded moments in which several animals of a home are together."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Int

from pipeline.behavior.avoidance import clearance_of
from pipeline.behavior.trajectories import TRAIN, BehaviorData, Trajectory


def recorded_at(data: BehaviorData, window: int) -> tuple[Trajectory, int]:
    """Return the recording of a window and the window's first frame in it."""
    return data.trajectories[data.videos[int(data.video[window])]], int(data.start[window])


def moments_together(
    data: Mapping[str, BehaviorData],
    leading: str,
    window: int,
    split: int = TRAIN,
    home_of: Mapping[str, Int[np.ndarray, "window"]] | None = None,
) -> dict[str, int]:
    """Return a window of each animal: the others' are the nearest in time to the ``window`` of the
    ``leading`` one, preferably of the same recording, in which bodies do not overlap, if there is one.

    They are of its home, if homes of windows are given, and of ``split``, or of any split for an animal that
    has none in it.
    """
    windows, begin_s = {leading: window}, data[leading].begin_s[window]
    placed = data[leading].place_world[[window]]
    video = data[leading].videos[int(data[leading].video[window])]
    for name in (other for other in data if other != leading):
        mine = data[name]
        among = mine.split >= 0 if home_of is None else home_of[name] == home_of[leading][window]
        in_split = among & (mine.split == split)
        known = np.flatnonzero(in_split if in_split.any() else among)
        elsewhere = np.array(mine.videos)[mine.video[known]] != video
        order = known[np.lexsort((np.abs(mine.begin_s[known] - begin_s), elsewhere))]
        off = (placed[:, None] - mine.place_world[order])[..., [0, 2]]
        free = (np.linalg.norm(off, axis=-1) >= clearance_of(mine.agent_from_bone_rest)).all(0)
        windows[name] = int(order[free.argmax()])
        placed = np.concatenate([placed, mine.place_world[[windows[name]]]])
    return windows
