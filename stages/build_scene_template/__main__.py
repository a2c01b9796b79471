"""Build the scene template from the walk-through.

COLMAP (CPU, one thread) finds the keyframes' poses; depth gives the scale and verifies the poses; where depth
refutes them, odometry replaces them; gravity turns +y up. Depth and colour are fused to a mesh, every frame
is aligned to it, pymeshlab cleans it. Writes mesh.ply, vertex_features.npz, cameras.npz, world.json and
colmap/.
"""

from pipeline.workflow import cli
from stages.build_scene_template import stage
from stages.build_scene_template.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
