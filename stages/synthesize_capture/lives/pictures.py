"""What the quality page of simulated lives shows: homes from above with the animal's ways, and some
shares.
"""

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.data import plots
from pipeline.data.qa import Check, Picture
from pipeline.metrics.flight import flees
from stages.synthesize_capture.lives.approaches import ScriptedApproaches
from stages.synthesize_capture.lives.lives import RATE_HZ, SimulatedLife
from stages.synthesize_capture.policy import REASONS

ROOT_CELLS = slice(3, 6)
"""Levels of the volume, 0.1 to 0.4 m, at which the animal walks."""


def pictures(lived: dict[str, SimulatedLife]) -> list[Picture]:
    """Draw up to eight sessions, evenly chosen."""
    names = list(lived)[:: max(len(lived) // 8, 1)][:8]
    caption = (
        "Homes from above: what stands between 0.1 and 0.4 m (grey), the "
        "animal's way (blue), the person's (green)."
    )
    return [Picture("homes", homes({name: lived[name] for name in names}), caption)]


def homes(lived: dict[str, SimulatedLife]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw sessions over their homes."""
    figure, axes = plots.panels(2, 4, width_in=12, height_in=5.2)
    for axis, (name, life) in zip(axes.ravel(), lived.items(), strict=False):
        volume = life.volume
        solid = (volume.occupancy[:, ROOT_CELLS] == 1).any(1)
        plots.floor_plan(axis, solid, volume.origin[[0, 2]], volume.voxel_m)
        restarts = np.flatnonzero(np.diff(life.timestamp_s) > 1.5 / RATE_HZ) + 1
        for poses, color in ((life.world_from_camera, plots.GREEN), (life.world_from_agent, plots.BLUE)):
            axis.plot(*np.insert(poses[:, [0, 2], 3], restarts, np.nan, axis=0).T, color=color, linewidth=0.7)
        axis.set(title=name, xticks=[], yticks=[])
    return plots.pixels(figure)


def checks(lived: dict[str, SimulatedLife], met: ScriptedApproaches | None) -> list[Check]:
    """Judge the lives."""
    reason = np.concatenate([life.reason for life in lived.values()])
    inside = np.concatenate([_inside(life) for life in lived.values()])
    minutes = sum(len(life.timestamp_s) for life in lived.values()) / RATE_HZ / 60
    shares = [
        Check(f"share of time: {name}", float((reason == code).mean()), "")
        for code, name in enumerate(REASONS)
    ]
    found = [Check("minutes in all", minutes, "min", 1, 0.5, "higher"), *shares]
    found.append(Check("root inside something solid", float(inside.mean()), "share", 0.01, 0.05))
    if met:
        walked, stood = fled(met)
        found += [
            Check("flees from a walking person", walked, "share", 0.6, 0.4, "higher"),
            Check("flees from a standing one", stood, "share", 0.2),
        ]
    return found


def fled(met: ScriptedApproaches) -> tuple[float, float]:
    """Return in which shares of approaches, and of their twins, the animal flees."""
    past = met.observer.shape[2]
    root = met.world_from_agent[..., :3, 3]
    flight = flees(root[:, :, past:], root[:, :, past - 1], met.observer[:, :, -1])
    return float(flight[0].mean()), float(flight[1].mean())


def _inside(life: SimulatedLife) -> Float[np.ndarray, "frame"]:
    voxel, known = life.volume.voxel(life.world_from_agent[:, :3, 3])
    return (life.volume.occupancy[tuple(voxel.T)] == 1) | ~known
