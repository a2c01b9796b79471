"""Train the network that recognizes the turnaround's animal in sessions without depth.

Once per animal; `estimate_depth` and `segment_agent` read it for every session that is a plain video.
"""

from pipeline.workflow import cli
from stages.train_recognizer import stage
from stages.train_recognizer.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
