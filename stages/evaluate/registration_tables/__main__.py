"""Tabulate the registration against its ablations, in the shape of the paper's Table 1.

Every frame of every session counts; a recording that was refused counts as failed. Writes tables.json
(flat) and tables.txt (to be read).
"""

from pipeline.workflow import cli
from stages.evaluate.registration_tables import stage
from stages.evaluate.registration_tables.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
