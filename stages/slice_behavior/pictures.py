"""What the quality page of the behavior data shows: visits, speeds and distances, windows per recording."""

from collections.abc import Collection

import numpy as np
from jaxtyping import UInt8

from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.trajectories import TEST, TRAIN, BehaviorData
from pipeline.data import plots
from pipeline.data.qa import Check, Picture, captioned
from pipeline.geometry import subsampling

MOVED_M = 0.15
VISIT_M = 0.1
"""Edge of the cells in which visits are counted."""
CAPTIONS = {
    "visitation": "Where animal (left) and observer (right) have been in training, from above.",
    "histograms": "The animal's speed, distance to the observer, and how far it gets (training).",
    "windows": "Valid times of every recording, and how many windows start there.",
}
MAX_WINDOWS = 8192
"""Training windows that are gathered, evenly chosen: a day of a table holds 864 000, of 16 KB each."""


def pictures(data: BehaviorData, volume: FeatureVolume, test: Collection[str]) -> list[Picture]:
    """Draw the training recordings for people; the test recordings only count."""
    where, when = visitation(data, volume, test), validity(data, test)
    return captioned(CAPTIONS, visitation=where, histograms=histograms(data), windows=when)


def checks(data: BehaviorData) -> list[Check]:
    """Judge the data."""
    train, test = data.indices(TRAIN), data.indices(TEST)
    shared = set(data.video[train]) & set(data.video[test])
    context, future = data.windows(subsampling.some(train, MAX_WINDOWS), bones=False)
    moved = np.linalg.norm(future.goal_world - context.world_from_agent[:, -1, :3, 3], axis=-1) > MOVED_M
    valid = np.concatenate([trajectory.valid for trajectory in data.trajectories.values()])
    moving = f"training windows in which the animal moves more than {MOVED_M:g} m"
    return [
        Check("training windows", len(train), "windows", 200, 1, "higher"),
        Check("test windows", len(test), "windows", 1, None, "higher"),
        Check("recordings in both training and test", len(shared), "recordings", 0, 0),
        Check("valid times", float(valid.mean()), "share", 0.7, 0.2, "higher"),
        Check(moving, float(moved.mean()) if len(moved) else None, "share", 0.2, None, "higher"),
    ]


def visitation(
    data: BehaviorData, volume: FeatureVolume, test: Collection[str]
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw heat maps of visits over the columns that hold surfaces."""
    figure, axes = plots.panels(1, 2, width_in=9, height_in=4.2)
    solid = (volume.occupancy[:, min(2, volume.occupancy.shape[1] - 1) :] == 1).mean(1)
    low = volume.origin[[0, 2]]
    high = low + np.array(solid.shape) * volume.voxel_m
    bins = [np.arange(low[axis], high[axis] + VISIT_M, VISIT_M) for axis in (0, 1)]
    tracks = {"animal": "world_from_agent", "observer": "world_from_camera"}
    for axis, (name, key) in zip(axes[0], tracks.items(), strict=True):
        known = [track for video, track in data.trajectories.items() if video not in test]
        places = [getattr(track, key)[track.valid, :3, 3] for track in known]
        plots.floor_plan(axis, solid, low, volume.voxel_m)
        if places:
            count = np.histogram2d(*np.concatenate(places)[:, [0, 2]].T, bins=bins)[0]
            shown = np.where(count > 0, np.log1p(count), np.nan)
            plots.floor_plan(axis, shown, low, VISIT_M, cmap="inferno", vmax=None, alpha=0.8)
        axis.set(title=name, xlabel="x [m]", ylabel="z [m]", aspect="equal")
    return plots.pixels(figure)


def histograms(data: BehaviorData) -> UInt8[np.ndarray, "height width 3"]:
    """Draw speed, distance and displacement."""
    context, future = data.windows(subsampling.some(data.indices(TRAIN), MAX_WINDOWS), bones=False)
    position = future.path_world
    speed = np.linalg.norm(np.diff(position, axis=1), axis=-1)[:, ::7] * data.rate_hz
    away = (context.observer_world - context.world_from_agent[..., :3, 3])[:, -1]
    distance = np.linalg.norm(away[:, ::2], axis=-1)
    moved = np.linalg.norm(future.goal_world - context.world_from_agent[:, -1, :3, 3], axis=-1)
    displacement = f"displacement in {data.future / data.rate_hz:g} s [m]"
    return plots.histograms(
        {"speed [m/s]": speed, "distance to the observer [m]": distance, displacement: moved}
    )


def validity(data: BehaviorData, test: Collection[str]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw valid times and window starts per recording."""
    figure, axes = plots.panels(1, 1, width_in=9, height_in=0.5 + 0.4 * max(len(data.videos), 2))
    axis, names = axes[0, 0], []
    for row, video in enumerate(data.videos):
        trajectory, mine = data.trajectories[video], data.video == row
        valid, starts = trajectory.timestamp_s[trajectory.valid], trajectory.timestamp_s[data.start[mine]]
        axis.scatter(valid, np.full(len(valid), row), s=3, color=plots.BLUE)
        axis.scatter(starts, np.full(len(starts), row + 0.25), s=3, color=plots.RED)
        names.append(f"{video} {'test' if video in test else 'train'}: {mine.sum()}")
    axis.set_yticks(range(len(names)), names)
    axis.set_xlabel(f"time [s]: valid (blue), starts of windows of {data.past + data.future} frames (red)")
    return plots.pixels(figure)
