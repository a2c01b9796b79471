"""An action that was seen once, generated at places where it never was (Fig. 15): jumping off furniture.

    python -m benchmarks.behavior_once benchmark --settings table.toml --picture once.png

Needs a finished `behavior_data` with test recordings. Models learn from the same recordings: one is shown a
single visit to something high, with the jump on to it and off it, one no such visit, one all of them. Each is
asked for plans where the animal of the test recordings jumped off, and where it stayed.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from matplotlib.figure import Figure

from benchmarks.behavior_gap import trained
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import PAST, RATE_HZ, TEST, TRAIN, BehaviorData, Trajectory
from pipeline.core import config
from pipeline.data import images, plots
from pipeline.rivals.predictors import Ats
from stages.slice_behavior.windows import slice_windows
from stages.train_behavior.config import Config

HIGH_M = 0.25
"""a root this much higher than usual is on top of something"""
JUMP_FRAMES = 8
"""frames before and after a visit that belong to its jumps"""
SAMPLES = 16
SHOWN = 4


@dataclass(frozen=True)
class Visit:
    """One stay on top of something."""

    video: str
    frames: slice
    """from before the jump on to it until after the jump off it"""


@dataclass(frozen=True)
class Moments:
    """Windows of the test recordings that begin on top of something."""

    off: Int[np.ndarray, "window"]
    """in which the animal is down again at the end"""
    stays: Int[np.ndarray, "window"]
    """in which it stays throughout"""
    jumps: int
    """jumps off that they hold"""


def usual_height(data: BehaviorData) -> float:
    """Return the median height of the root."""
    return float(
        np.median(np.concatenate([t.world_from_agent[t.valid, 1, 3] for t in data.trajectories.values()]))
    )


def high_frames(trajectory: Trajectory, usual_m: float) -> Bool[np.ndarray, "frame"]:
    """Tell in which frames the animal is on top of something."""
    return trajectory.valid & (trajectory.world_from_agent[:, 1, 3] > usual_m + HIGH_M)


def visits(data: BehaviorData, split: int, usual_m: float) -> list[Visit]:
    """Return the stays of a split's recordings that were seen from the jump on to something to the jump off
    it.
    """
    found = []
    for number in np.unique(data.video[data.indices(split)]):
        name = data.videos[number]
        high = high_frames(data.trajectories[name], usual_m)
        edges = np.diff(high.astype(int), prepend=0, append=0)
        for begin, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
            frames = slice(begin - JUMP_FRAMES, end + JUMP_FRAMES)
            if (
                frames.start >= 0
                and data.trajectories[name].valid[frames].sum() == frames.stop - frames.start
            ):
                found.append(Visit(name, frames))
    return found


def shown(data: BehaviorData, kept: list[Visit], usual_m: float) -> BehaviorData:
    """Return the data whose training recordings are on top of things in ``kept`` visits only."""
    test = frozenset(data.videos[number] for number in np.unique(data.video[data.indices(TEST)]))
    trajectories = {}
    for name, trajectory in data.trajectories.items():
        hidden = np.convolve(high_frames(trajectory, usual_m), np.ones(2 * JUMP_FRAMES + 1), "same") > 0
        for visit in kept:
            if visit.video == name:
                hidden[visit.frames] = False
        trajectories[name] = (
            trajectory if name in test else replace(trajectory, valid=trajectory.valid & ~hidden)
        )
    return slice_windows(trajectories, test, data.agent_from_bone_rest, stride=1)


def moments(data: BehaviorData, usual_m: float, stride: int) -> Moments:
    """Choose windows of the test recordings that begin on top of something, every ``stride``-th."""
    index = data.indices(TEST)
    high = {
        number: high_frames(data.trajectories[data.videos[number]], usual_m)
        for number in np.unique(data.video[index])
    }

    def at(frame: int) -> Bool[np.ndarray, "window"]:
        return np.array(
            [
                high[video][start + frame]
                for video, start in zip(data.video[index], data.start[index], strict=True)
            ]
        )

    begins, length = at(PAST - 1), PAST + data.future
    off, stays = (
        index[begins & ~at(length - 1)],
        index[begins & np.all([at(frame) for frame in range(PAST, length)], axis=0)],
    )
    jumps = {
        (video, start + PAST + int(np.argmin(high[video][start + PAST : start + length])))
        for video, start in zip(data.video[off], data.start[off], strict=True)
    }
    return Moments(off[::stride], stays[::stride], len(jumps))


def paths(
    ats: Ats, data: BehaviorData, index: Int[np.ndarray, "window"]
) -> Float[np.ndarray, "window sample frame 3"]:
    """Sample paths of some windows, in the world."""
    return ats.sample(data.windows(index)[0], SAMPLES, np.random.default_rng(0)).path


def counted(ats: Ats, data: BehaviorData, met: Moments, usual_m: float) -> dict[str, float]:
    """Count plans that jump off, and say where those land that do so where the animal did."""
    off, stays = (paths(ats, data, index) for index in (met.off, met.stays))
    down = off[:, :, -1, 1] < usual_m + HIGH_M
    landing = off[down][:, -1]
    window = np.nonzero(down)[0]
    spread = [np.linalg.norm(off[w, down[w], -1][:, [0, 2]].std(0)) for w in np.flatnonzero(down.sum(1) > 1)]
    return {
        "jump off where the animal does": float(down.mean()),
        "windows where some plan does": float(down.any(1).mean()),
        "jump off where the animal stays": float((stays[:, :, -1, 1] < usual_m + HIGH_M).mean()),
        "height after it, off the usual [m]": float(np.abs(landing[:, 1] - usual_m).mean())
        if len(landing)
        else np.nan,
        "land in something solid": float(ats.scenes.inside_solid(landing, data.video[met.off[window]]).mean())
        if len(landing)
        else np.nan,
        "landings of a window spread by [m]": float(np.mean(spread)) if spread else np.nan,
    }


def picture(models: dict[str, Ats], data: BehaviorData, met: Moments, usual_m: float):
    """Draw some windows in which the animal jumps off: height over time, one row per model, what the animal
    does in black.
    """
    index = met.off[np.linspace(0, len(met.off) - 1, SHOWN + 2).astype(int)[1:-1]]
    _, future = data.windows(index)
    figure = Figure(figsize=(2.6 * SHOWN, 2.0 * len(models)), dpi=90, layout="constrained")
    grid = figure.subplots(len(models), SHOWN, squeeze=False, sharex=True, sharey=True)
    for row, (name, ats) in zip(grid, models.items(), strict=True):
        for axis, sampled, true in zip(row, paths(ats, data, index), future.path_world, strict=True):
            seconds = np.arange(1, len(true) + 1) / RATE_HZ
            axis.plot(seconds, sampled[:, :, 1].T - usual_m, color="#c44e52", linewidth=0.8, alpha=0.6)
            axis.plot(seconds, true[:, 1] - usual_m, color="black", linewidth=1.5)
        row[0].set_ylabel(f"{name}\nheight [m]")
    for axis in grid[-1]:
        axis.set_xlabel("s")
    return plots.pixels(figure)


def main() -> None:
    """Train the models, print what they do, and draw some of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("agent")
    parser.add_argument("--build", type=Path, default=Path("build"))
    parser.add_argument(
        "--settings", type=Path, help="table of train_behavior, JSON or TOML (default: its defaults)"
    )
    parser.add_argument(
        "--visits", type=int, default=1, help="so many single visits, each for a model of its own"
    )
    parser.add_argument("--stride", type=int, default=10, help="every so many windows are asked")
    parser.add_argument("--picture", type=Path, help="where to draw some of it")
    given = parser.parse_args()
    torch.set_num_threads(1)
    folder = given.build / given.agent / "behavior_data"
    data = BehaviorData.load(folder)
    scenes, usual_m = Scenes.load(folder, data.videos), usual_height(data)
    settings = config.load(Config, given.settings) if given.settings else Config()
    learned, met = visits(data, TRAIN, usual_m), moments(data, usual_m, given.stride)
    chosen = np.linspace(0, len(learned) - 1, given.visits + 2).astype(int)[1:-1]
    print(
        f"{len(learned)} visits to learn from; asked in {len(met.off)} windows of {met.jumps} jumps off, {len(met.stays)} of stays"
    )
    models = {}
    single = {f"once, in {learned[number].video}": [learned[number]] for number in chosen}
    for name, kept in {**single, "never": [], "all": learned}.items():
        told = shown(data, kept, usual_m)
        models[name] = trained(told, scenes, settings)
        print(f"{name}: {len(kept)} visits in {len(told.indices(TRAIN))} windows", flush=True)
        for what, value in counted(models[name], data, met, usual_m).items():
            print(f"  {what:40s} {value:.3f}", flush=True)
    if given.picture:
        images.write_color(given.picture, picture(models, data, met, usual_m))


if __name__ == "__main__":
    main()
