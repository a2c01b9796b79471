"""Make the tables of the behavior methods: every method with several seeds, judged on the same windows.

Writes flat figures (`tables.json`), the tables as text, and the exact windows. Intervals of 95 % are drawn
over training seeds and over episodes of the test recordings.
"""

from pipeline.workflow import cli
from stages.tabulate_behavior import stage
from stages.tabulate_behavior.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
