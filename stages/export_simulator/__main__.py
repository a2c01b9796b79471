"""Make the simulator: one page that opens by itself, and animated files for other programs.

Reads `reconstruction`, `splats`, `behavior` and `behavior_data`. Writes `index.html` (the page: scene,
animal, the three diffusion models, everything embedded; nothing is requested), `agent.glb` (skinned, with
every recorded session as an animation), `scene.glb` and `simulator.json` (the contract that any other player
must know).
"""

from pipeline.workflow import cli
from stages.export_simulator import stage
from stages.export_simulator.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
