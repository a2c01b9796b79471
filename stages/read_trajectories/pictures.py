"""What the quality page of a table of motion shows."""

import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure

from pipeline import figures
from pipeline.qa import Check, Picture
from pipeline.space import rigid
from stages.read_trajectories.life import Life

FASTEST_M_S = 12.0
"""Hardly any animal at home is faster."""
FASTEST_RAD_S = 10.0
"""Nor does any turn faster; degrees that are read as radians do."""


def pictures(life: Life) -> list[Picture]:
    """Draw the way from above."""
    return [Picture("way", way(life), "The animal's way from above, over what stands in it.")]


def way(life: Life) -> UInt8[np.ndarray, "height width 3"]:
    """Draw obstacles grey, the way blue."""
    figure = Figure(figsize=(5, 4), dpi=80, layout="constrained")
    axis, volume = figure.subplots(), life.volume
    low = volume.origin[[0, 2]]
    high = low + np.array(volume.occupancy.shape)[[0, 2]] * volume.voxel_m
    solid = (volume.occupancy[:, 3:] == 1).any(1)
    if solid.size > 1:
        axis.imshow(solid.T, cmap="Greys", extent=(low[0], high[0], high[1], low[1]), vmax=2)
    axis.plot(*life.world_from_agent[:, [0, 2], 3].T, ".", color="#3b6ea5", markersize=1)
    axis.set(xlabel="x [m]", ylabel="z [m]", aspect="equal")
    return figures.pixels(figure)


def checks(life: Life) -> list[Check]:
    """Judge the motion."""
    step = np.diff(life.timestamp_s)
    speed = np.linalg.norm(np.diff(life.world_from_agent[:, :3, 3], axis=0), axis=-1) / np.maximum(step, 1e-6)
    within = speed[(step < 1.0) & np.isfinite(speed)]
    rotation = life.world_from_agent[:, :3, :3]
    turning = (rigid.rotation_angle(rotation[:-1], rotation[1:]) / np.maximum(step, 1e-6))[(step < 1.0) & np.isfinite(speed)]
    voxel, known = life.volume.voxel(np.nan_to_num(life.world_from_agent[:, :3, 3]))
    solid = (life.volume.occupancy[tuple(voxel.T)] == 1) & known
    return [
        Check("seconds", float(step[step < 1.0].sum()), "s", 20, 6.4, "higher"),
        Check("speed, 99 % below", float(np.quantile(within, 0.99)) if len(within) else None, "m/s", FASTEST_M_S),
        Check("turning, 99 % below", float(np.quantile(turning, 0.99)) if len(turning) else None, "rad/s", FASTEST_RAD_S),
        Check("positions in obstacles", float(solid.mean()), "share", 0.01, 0.2),
    ]
