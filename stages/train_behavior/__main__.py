"""Train the behavior model: what the animal perceives, where it goes next, along which path, with which
body.

Goal, path and body are three diffusion models under one perception code; conditions are dropped at random for
classifier-free guidance. Writes weights, ONNX networks and the contract that every sampler follows.
"""

from pipeline.workflow import cli
from stages.train_behavior import stage
from stages.train_behavior.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
