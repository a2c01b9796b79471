"""Turn the pictures of a plain video into frames with depth, given the map of the walk-through.

Cameras and lens are estimated by matching the pictures with the walk-through. The room's depth is rendered
from the map. The animal's is inferred: in sessions from its contact with the map, or by a monocular network
scaled by the map; in turnarounds, where the animal rests, by multi-view stereo.
"""

from pipeline.workflow import cli
from stages.estimate_depth import stage
from stages.estimate_depth.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
