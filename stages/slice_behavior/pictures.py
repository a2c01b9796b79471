"""What the quality page of the behaviour data shows: visits, speeds and distances, windows per recording."""

from collections.abc import Collection

import numpy as np
from jaxtyping import Int, UInt8
from matplotlib.figure import Figure

from pipeline import figures
from pipeline.models.perception import FeatureVolume
from pipeline.models.trajectories import FUTURE, PAST, RATE_HZ, TEST, TRAIN, BehaviorData
from pipeline.qa import Check, Picture

MOVED_M = 0.15
MOST_WINDOWS = 8192
"""Training windows that are gathered, evenly chosen: a day of a table holds 864 000, of 16 KB each."""


def pictures(data: BehaviorData, volume: FeatureVolume, test: Collection[str]) -> list[Picture]:
    """Draw the training recordings for people; the test recordings only count."""
    return [
        Picture(
            "visitation",
            visitation(data, volume, test),
            "Where animal (left) and observer (right) have been in the training recordings, over the room from above.",
        ),
        Picture(
            "histograms",
            histograms(data),
            "The animal's speed, its distance to the observer, and how far it gets in 5.6 s (training).",
        ),
        Picture("windows", validity(data, test), "Valid times of every recording, and how many windows start there."),
    ]


def checks(data: BehaviorData) -> list[Check]:
    """Judge the data."""
    train, test = data.indices(TRAIN), data.indices(TEST)
    shared = set(data.video[train]) & set(data.video[test])
    context, future = data.windows(some(train), bones=False)
    moved = np.linalg.norm(future.goal_world - context.world_from_agent[:, -1, :3, 3], axis=-1) > MOVED_M
    valid = np.concatenate([trajectory.valid for trajectory in data.trajectories.values()])
    return [
        Check("training windows", len(train), "windows", 200, 1, "higher"),
        Check("test windows", len(test), "windows", 1, None, "higher"),
        Check("recordings in both training and test", len(shared), "recordings", 0, 0),
        Check("valid times", float(valid.mean()), "share", 0.7, 0.2, "higher"),
        Check(
            f"training windows in which the animal moves more than {MOVED_M:g} m",
            float(moved.mean()) if len(moved) else None,
            "share",
            0.2,
            None,
            "higher",
        ),
    ]


def some(windows: Int[np.ndarray, "window"]) -> Int[np.ndarray, "chosen"]:
    """Return evenly chosen windows, all where they are few."""
    return windows[np.linspace(0, len(windows) - 1, min(len(windows), MOST_WINDOWS)).astype(int)]


def visitation(data: BehaviorData, volume: FeatureVolume, test: Collection[str]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw heat maps of visits over the columns that hold surfaces."""
    figure = Figure(figsize=(9, 4.2), dpi=80, layout="constrained")
    axes = figure.subplots(1, 2)
    solid = (volume.occupancy[:, min(2, volume.occupancy.shape[1] - 1) :] == 1).mean(1)
    low = volume.origin[[0, 2]]
    high = low + np.array(solid.shape) * volume.voxel_m
    bins = [np.arange(low[axis], high[axis] + 0.1, 0.1) for axis in (0, 1)]
    tracks = {"animal": "world_from_agent", "observer": "world_from_camera"}
    for axis, (name, key) in zip(axes, tracks.items(), strict=True):
        places = [getattr(data.trajectories[v], key)[data.trajectories[v].valid, :3, 3] for v in data.videos if v not in test]
        count, *_ = np.histogram2d(*np.concatenate(places)[:, [0, 2]].T, bins=bins) if places else (np.zeros((1, 1)),)
        axis.imshow(solid.T, cmap="Greys", extent=(low[0], high[0], high[1], low[1]), vmax=1.5)
        axis.imshow(
            np.where(count > 0, np.log1p(count), np.nan).T,
            cmap="inferno",
            extent=(low[0], high[0], high[1], low[1]),
            alpha=0.8,
        )
        axis.set(title=name, xlabel="x [m]", ylabel="z [m]")
    return figures.pixels(figure)


def histograms(data: BehaviorData) -> UInt8[np.ndarray, "height width 3"]:
    """Draw speed, distance and displacement."""
    context, future = data.windows(some(data.indices(TRAIN)), bones=False)
    position = future.path_world
    speed = np.linalg.norm(np.diff(position, axis=1), axis=-1)[:, ::7] * RATE_HZ
    distance = np.linalg.norm((context.observer_world - context.world_from_agent[..., :3, 3])[:, -1][:, ::2], axis=-1)
    moved = np.linalg.norm(future.goal_world - context.world_from_agent[:, -1, :3, 3], axis=-1)
    figure = Figure(figsize=(9, 2.6), dpi=80, layout="constrained")
    labels = ("speed [m/s]", "distance to the observer [m]", "displacement in 5.6 s [m]")
    for axis, values, label in zip(figure.subplots(1, 3), (speed, distance, moved), labels, strict=True):
        axis.hist(values.ravel(), bins=40, color="#3b6ea5")
        axis.set_xlabel(label)
    return figures.pixels(figure)


def validity(data: BehaviorData, test: Collection[str]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw valid times and window starts per recording."""
    figure = Figure(figsize=(9, 0.5 + 0.4 * max(len(data.videos), 2)), dpi=80, layout="constrained")
    axis = figure.subplots()
    for row, video in enumerate(data.videos):
        trajectory = data.trajectories[video]
        axis.scatter(trajectory.timestamp_s[trajectory.valid], np.full(trajectory.valid.sum(), row), s=3, color="#3b6ea5")
        mine = data.video == row
        axis.scatter(trajectory.timestamp_s[data.start[mine]], np.full(mine.sum(), row + 0.25), s=3, color="#c44e52")
    names = [f"{video} {'test' if video in test else 'train'}: {(data.video == row).sum()}" for row, video in enumerate(data.videos)]
    axis.set_yticks(range(len(names)), names)
    axis.set_xlabel(f"time [s]: valid (blue), starts of windows of {PAST + FUTURE} frames (red)")
    return figures.pixels(figure)
