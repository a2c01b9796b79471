"""Turn reconstructed motion into trajectories on a 10 Hz grid and windows of 6.4 s for the behaviour model.

A window is 0.8 s of past and 5.6 s of future, all of it valid; the split is by recording. Motion comes from
the reconstruction or from tables. Writes also the scenes' feature volumes, with the voxels in which the
animal may be.
"""

from pipeline.workflow import cli
from stages.slice_behavior import stage
from stages.slice_behavior.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
