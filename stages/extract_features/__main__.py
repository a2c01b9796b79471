"""Describe every frame of one video by 16 unit-length features at every eighth pixel, in the shared basis."""

from pipeline.workflow import cli
from stages.extract_features import stage
from stages.extract_features.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
