"""Train long-term motion: bodies at sub-goals, routes between them, poses along routes, in two-second pieces.

Reads reconstructed sessions at 30 fps (spline on positions, slerp on rotations), or simulated motion in
several homes; finds from them which parts of the body touch the scene. `stages.simulate --subgoals` makes
motion with the result.
"""

from pipeline.workflow import cli
from stages.train_longterm import stage
from stages.train_longterm.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
