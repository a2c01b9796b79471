"""Reconstruct scene, agent and motion in 4D from registered recordings.

The scene's signed distance is fused depth, or learned (`scene_geometry`); its field learns color and features
with a code per video. The agent's field starts from the template and is posed by 25 Gaussian bones. Poses of
cameras, root and bones are optimized with the fields by color, depth, masks, flow and features of all
registered sessions, the walk-through and the turnaround. Then surfaces, skin, motion per video and the
scene's feature volume are extracted.
"""

from pipeline.workflow import cli
from stages.reconstruct import stage
from stages.reconstruct.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
