"""Quality page of a table of motion."""

import numpy as np
from jaxtyping import Float

from pipeline.data import plots
from pipeline.data.qa import Check, Picture
from pipeline.geometry import rigid
from stages.read_trajectories.motion import MeasuredMotion

FASTEST_M_S = 12.0
"""Maximum plausible speed of an animal at home."""
FASTEST_RAD_S = 10.0
"""Maximum plausible angular speed; degrees read as radians exceed it."""


def pictures(motion: MeasuredMotion) -> list[Picture]:
    """Draw the trajectory (blue) from above over obstacles (gray)."""
    figure, axes = plots.panels(1, 1, width_in=5, height_in=4)
    volume, axis = motion.volume, axes[0, 0]
    plots.floor_plan(axis, (volume.occupancy[:, 3:] == 1).any(1), volume.origin[[0, 2]], volume.voxel_m)
    axis.plot(*motion.world_from_agent[:, [0, 2], 3].T, ".", color=plots.BLUE, markersize=1)
    axis.set(xlabel="x [m]", ylabel="z [m]", aspect="equal")
    caption = "The animal's way from above, over what stands in it."
    return [Picture("way", plots.pixels(figure), caption)]


def checks(motion: MeasuredMotion) -> list[Check]:
    """Return quality checks of the motion."""
    step, rotation = np.diff(motion.timestamp_s), motion.world_from_agent[:, :3, :3]
    way = np.linalg.norm(np.diff(motion.world_from_agent[:, :3, 3], axis=0), axis=-1)
    known = (step < 1.0) & np.isfinite(way)

    def most(change: Float[np.ndarray, "step"]) -> float | None:
        return float(np.quantile((change / np.maximum(step, 1e-6))[known], 0.99)) if known.any() else None

    turned = rigid.rotation_angle(rotation[:-1], rotation[1:])
    voxel, inside = motion.volume.voxel(motion.world_from_agent[motion.arrays()["agent_visible"], :3, 3])
    solid = (motion.volume.occupancy[tuple(voxel.T)] == 1) & inside
    return [
        Check("seconds", float(step[step < 1.0].sum()), "s", 20, 6.4, "higher"),
        Check("speed, 99 % below", most(way), "m/s", FASTEST_M_S),
        Check("turning, 99 % below", most(turned), "rad/s", FASTEST_RAD_S),
        Check("positions in obstacles", float(solid.mean()), "share", 0.01, 0.2),
    ]
