"""Simulate the built-in animal's motion in several homes, without pictures: what long-term motion is measured
on.

Writes its body, the surface of every home as it was in each session, and its motion at 30 fps. The last home
is never learned from, nor is the last session of each other home.
"""

from pipeline.workflow import cli
from stages.synthesize_capture.motions import stage
from stages.synthesize_capture.motions.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
