"""Measure behavior beside simple baselines, and put all metrics of a build together."""

from pipeline.workflow import cli
from stages.evaluate import stage
from stages.evaluate.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
