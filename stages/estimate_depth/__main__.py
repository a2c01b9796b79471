"""Turn the pictures of a plain video into frames with depth, by the map of the walk-through.

Cameras come from what the pictures and the walk-through show alike; the lens is calibrated with them. The
room's depth is the map's. The animal's is inferred: in a session from where it touches the map, or by a
monocular network that the map scales. Of a turnaround several views measure it, since the animal rests.
"""

from pipeline.workflow import cli
from stages.estimate_depth import stage
from stages.estimate_depth.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
