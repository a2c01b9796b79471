"""Make the tables of long-term motion (Tables 1, 2 and 4 of the paper), every variant with and without
optimization.

On held-out sessions and an unseen home of the built-in world, where the truth is known, and on the
reconstructed test recording; then minutes through many sub-goals, and samples of the behavior model before
and after.
"""

from pipeline.workflow import cli
from stages.tabulate_longterm import stage
from stages.tabulate_longterm.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
