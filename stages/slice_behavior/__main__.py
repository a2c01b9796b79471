"""Turn reconstructed motion into trajectories on an even grid and windows for the behavior model.

A window is past (0.8 s) and future (5.6 s), all of it valid; the split is by recording. Motion comes from
the reconstruction or from tables. Writes also the scenes' feature volumes, with the voxels in which the
animal may be.
"""

from pipeline.workflow import cli
from stages.slice_behavior import stage
from stages.slice_behavior.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
