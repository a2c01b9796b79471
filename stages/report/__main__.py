"""Write the report of a build: an index with traffic lights and metrics, and one page per stage.

Reads the notes (`qa.json`, pictures, settings) of every artifact and `evaluation/metrics.json`; computes
nothing again. Every page is one file that can be sent by itself and asks nothing of the network. Beside them:
the methods in words with their references, and `ro-crate-metadata.json`, from which `make reproduce` builds
again and compares.
"""

from pipeline.workflow import cli
from stages.report import stage
from stages.report.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config, options=("share_safe",))
