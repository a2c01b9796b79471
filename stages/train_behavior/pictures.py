"""What the quality page of the behavior model shows: goal fans, the effect of guidance, losses."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Shaped, UInt8
from matplotlib.figure import Figure

from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.planning import Observation, Sampler
from pipeline.behavior.scenes import Scenes
from pipeline.core.training import FitRecord
from pipeline.data import plots
from pipeline.data.qa import Check, Picture, captioned
from pipeline.geometry import rigid
from stages.train_behavior.reactions import CLOSE_M, SIDES, WALK_M_S, Reactions, SampledMoments, approach

FAN_GOALS = 64
SHOWN_WINDOWS = 4
GUIDED_PATHS = 12
PANEL_IN = 2.6, 2.3
WINDOW_HALF_M = 3.0
CAPTIONS = {
    "goals": "Sampled goals (orange) with conditions removed; animal blue, others green; a column a moment.",
    "guidance": "The same with an observer who walks up from ahead; same noise at each interactivity.",
    "paths": "Sampled paths with and without the scene.",
    "guided_paths": "Paths to a given goal (blue dot), from dark to light in time, by scale of guidance "
    "(Fig. 14); 0 is the reference, which knows no goal.",
    "losses": "Squared error of the predicted noise, smoothed.",
}


def pictures(
    sampler: Sampler, moments: SampledMoments, scenes: Scenes, record: FitRecord, *, seed: int
) -> list[Picture]:
    """Draw a few training windows, sampled under different conditions."""
    chosen = np.linspace(0, len(moments.observation) - 1, SHOWN_WINDOWS + 2).astype(int)[1:-1]
    rooms = [RoomMap(scenes.volumes[number]) for number in moments.scene[chosen]]
    frame = moments.world_from_ego[chosen]
    some = moments.observation[chosen]
    removed = {
        "all": PlanSamplingConfig(),
        "no observer": PlanSamplingConfig(observer=False),
        "no scene": PlanSamplingConfig(scene=False),
        "no past": PlanSamplingConfig(past=False),
    }
    strength = {f"interactivity {s:g}": PlanSamplingConfig(guidance=s) for s in (0.0, 1.0, 2.0)}
    with_scene = {name: removed[name] for name in ("all", "no scene")}
    coming = approach(
        SIDES[0], CLOSE_M, WALK_M_S, frames=some.others.shape[2], rate_hz=sampler.scaling.rate_hz
    )
    close = replace(some, others=np.tile(coming, (len(chosen), 1, 1, 1)))
    return captioned(
        CAPTIONS,
        goals=fans(rooms, sampler, some, frame, removed, seed),
        guidance=fans(rooms, sampler, close, frame, strength, seed),
        paths=fans(rooms, sampler, some, frame, with_scene, seed, paths=True),
        guided_paths=guided_paths(rooms, sampler, some, frame, seed),
        losses=plots.loss_curves({"training": record.terms}),
    )


def checks(record: FitRecord, reactions: Reactions, onnx_difference: float) -> list[Check]:
    """Judge the training."""
    learned = {name: values[np.isfinite(values)] for name, values in record.terms.items()}
    last = {name: float(values[-max(len(values) // 10, 1) :].mean()) for name, values in learned.items()}
    each, share = "squared error of the noise, last tenth", reactions.away_share
    sides = "goals after an approach from one side against the other"
    return [
        *(Check(f"{name}: {each}", value, "", 0.9) for name, value in last.items()),
        Check("goals move away from an approaching observer", reactions.away_m, "m", 0.1, None, "higher"),
        Check("share of approaches that drive goals away", share, "share", 0.6, None, "higher"),
        Check(sides, reactions.reversal_m, "m", 0.2, None, "higher"),
        Check("shift by a far observer against none", reactions.far_m, "m", 0.01, 0.1),
        Check("shift by a far observer against a farther one", reactions.farther_m, "m", 0.01, 0.1),
        Check("ONNX against torch, largest difference", onnx_difference, "", 1e-4, 1e-2),
        Check("training fell back to a checkpoint", record.rolled_back, "times", 0),
    ]


def fans(
    rooms: "list[RoomMap]",
    sampler: Sampler,
    observation: Observation,
    frame: Float[np.ndarray, "window 4 4"],
    samplings: dict[str, PlanSamplingConfig],
    seed: int,
    *,
    paths: bool = False,
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw one row per way of sampling, one column per window."""
    figure, grid = windows_panels(len(samplings), len(frame))
    count = 12 if paths else FAN_GOALS
    for row, (name, sampling) in zip(grid, samplings.items(), strict=True):
        rng, codes = np.random.default_rng(seed), sampler.codes(observation, sampling, count)
        goals = sampler.goals(codes, rng)
        lines = None
        if paths:
            lines = sampler.paths(codes, goals, rng).reshape(len(frame), count, -1, 3)
        goals = goals.reshape(len(frame), count, 3)
        for column, axis in enumerate(row):
            rooms[column].window(axis, frame[column], observation.others[column, :, :, :3], goals[column])
            if lines is not None:
                rooms[column].lines(axis, frame[column], lines[column])
        row[0].set_ylabel(name)
    return plots.pixels(figure)


def windows_panels(rows: int, columns: int) -> tuple[Figure, Shaped[np.ndarray, "rows columns"]]:
    """Return a figure with a room in every panel."""
    width_in, height_in = PANEL_IN
    return plots.panels(rows, columns, width_in=width_in * columns, height_in=height_in * rows)


def guided_paths(
    rooms: "list[RoomMap]",
    sampler: Sampler,
    observation: Observation,
    frame: Float[np.ndarray, "window 4 4"],
    seed: int,
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw paths to one goal per window, the farthest of a few sampled ones, by scale of guidance."""
    windows, scales = len(frame), (1, 0.5, 0)
    figure, grid = windows_panels(len(scales), windows)
    plain = PlanSamplingConfig(max_path_draws=1)
    codes = sampler.codes(observation, plain, GUIDED_PATHS)
    sampled = sampler.goals(codes, np.random.default_rng(seed))
    sampled = sampled.reshape(windows, GUIDED_PATHS, 3)
    goal = sampled[np.arange(windows), np.linalg.norm(sampled, axis=-1).argmax(1)]
    for row, scale in zip(grid, scales, strict=True):
        sampling = replace(plain, guidance=scale)
        codes = sampler.codes(observation, sampling, GUIDED_PATHS)
        each = np.repeat(goal, GUIDED_PATHS, axis=0)
        paths = sampler.paths(codes, each, np.random.default_rng(seed))
        for column, axis in enumerate(row):
            some = paths.reshape(windows, GUIDED_PATHS, -1, 3)[column]
            rooms[column].steered(axis, frame[column], goal[column], some)
        row[0].set_ylabel(f"guidance {scale:g}")
    return plots.pixels(figure)


class RoomMap:
    """The room from above, to draw on."""

    def __init__(self, volume: FeatureVolume):
        self.solid = (volume.occupancy[:, min(3, volume.occupancy.shape[1] - 1) :] == 1).mean(1)
        self.low, self.voxel_m = volume.origin[[0, 2]], volume.voxel_m

    def window(
        self,
        axis,
        frame: Float[np.ndarray, "4 4"],
        others: Float[np.ndarray, "other frame 3"],
        goals: Float[np.ndarray, "sample 3"],
    ) -> None:
        goal = rigid.apply(frame, goals)
        axis.scatter(goal[:, 0], goal[:, 2], s=5, color=plots.ORANGE, alpha=0.7)
        for seen in rigid.apply(frame, others):
            axis.plot(seen[:, 0], seen[:, 2], color=plots.GREEN, linewidth=2)
            axis.scatter(*seen[-1, [0, 2]], color=plots.GREEN, s=25)
        arrow = *frame[[0, 2], 3], *frame[[0, 2], 2]
        axis.quiver(*arrow, angles="xy", color=plots.BLUE, scale=8, width=0.02)
        self.base(axis, frame)

    def steered(
        self,
        axis,
        frame: Float[np.ndarray, "4 4"],
        goal: Float[np.ndarray, "3"],
        paths: Float[np.ndarray, "sample frame 3"],
    ) -> None:
        for path in rigid.apply(frame, paths):
            axis.scatter(path[:, 0], path[:, 2], c=np.arange(len(path)), s=2, cmap="viridis")
        end = rigid.apply(frame, goal[None])[0]
        axis.scatter(end[0], end[2], color=plots.BLUE, s=32, edgecolors="white", zorder=3)
        self.base(axis, frame)

    def base(self, axis, frame: Float[np.ndarray, "4 4"]) -> None:
        plots.floor_plan(axis, self.solid, self.low, self.voxel_m)
        axis.set(xticks=[], yticks=[])
        if self.solid.size > 1:
            high = self.low + np.array(self.solid.shape) * self.voxel_m
            axis.set(xlim=(self.low[0], high[0]), ylim=(high[1], self.low[1]))
        else:  # nothing is known of the scene
            half = np.array([-WINDOW_HALF_M, WINDOW_HALF_M])
            axis.set(xlim=frame[0, 3] + half, ylim=frame[2, 3] - half)

    def lines(
        self, axis, frame: Float[np.ndarray, "4 4"], paths: Float[np.ndarray, "sample frame 3"]
    ) -> None:
        for path in rigid.apply(frame, paths):
            axis.plot(path[:, 0], path[:, 2], color=plots.RED, linewidth=0.8, alpha=0.7)
