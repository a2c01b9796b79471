"""Estimate the optical flow of one video between frames 1, 2, 4 and 8 apart, both ways, with confidence."""

from pipeline.workflow import cli
from stages.estimate_flow import stage
from stages.estimate_flow.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
