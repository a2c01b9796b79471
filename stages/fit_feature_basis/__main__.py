"""Fit the 16 feature channels jointly over the walk-through, the turnaround and the training sessions."""

from pipeline.workflow import cli
from stages.fit_feature_basis import stage
from stages.fit_feature_basis.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
