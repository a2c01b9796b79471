"""Replace the reconstruction's fields by 3D Gaussians and refine them against the pictures.

Gaussians cover the extracted surfaces of scene and agent; they, each video's exposure and, slightly, the
agent's motion are optimized by color, depth, silhouette and flow. Writes standard 3D Gaussian PLY files.
"""

from pipeline.workflow import cli
from stages.refine_gaussians import stage
from stages.refine_gaussians.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
