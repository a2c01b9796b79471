"""Score one trial of a behavior method on the test windows, end to end and fed with the truth.

Writes one number per window and score, with the exact list of windows, so that tables can draw intervals over
methods, seeds and episodes. Where there are scripted approaches, also how often the model's animal flees.
"""

from pipeline.workflow import cli
from stages.score_behavior import stage
from stages.score_behavior.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
