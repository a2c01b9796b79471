"""Build the scene template from the walk-through.

COLMAP (CPU, one thread) estimates the keyframe poses; depth gives the metric scale and verifies the poses,
and odometry replaces them where depth contradicts them; +y is aligned with gravity. Depth and color are
fused to a mesh, every frame is aligned to it, pymeshlab cleans it. Writes mesh.ply, vertex_features.npz,
cameras.npz, world.json and colmap/.
"""

from pipeline.workflow import cli
from stages.build_scene_template import stage
from stages.build_scene_template.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
