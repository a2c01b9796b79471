"""Read one table of an animal's motion, so that behavior can be learned without recordings.

Takes a CSV table (columns id, time, x, y, z, heading; optionally observer_x, observer_y, observer_z, kind), a
folder with `trajectory.csv` and `obstacles.csv` (occupied cells: x, z, optionally bottom, top), an NPZ file
of joint positions ([frame joint 3], one array per clip), or a built-in life. Meters, seconds, radians, +y up,
heading about +y from +z.
"""

from pipeline.workflow import cli
from stages.read_trajectories import stage
from stages.read_trajectories.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
