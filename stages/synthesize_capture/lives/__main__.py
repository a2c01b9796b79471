"""Simulate the built-in animal's life in several homes, without pictures: what behavior models are measured
on.

Writes one table of motion per session, each with its home as a feature volume, in the form that
`read_trajectories` takes; the last homes are unseen in training. Apart from them: scripted approaches in the
very last, with what the animal did.
"""

from pipeline.workflow import cli
from stages.synthesize_capture.lives import stage
from stages.synthesize_capture.lives.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
