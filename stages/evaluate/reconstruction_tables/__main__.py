"""Tabulate the reconstruction against its baselines and ablations, in the shape of the paper's Table 3.

All are rendered from the held-out phone and compared with what it truly saw; the agent's root and surface
points are followed in the sessions that this phone filmed too. Writes tables.json (flat) and tables.txt (to
be read).
"""

from pipeline.workflow import cli
from stages.evaluate.reconstruction_tables import stage
from stages.evaluate.reconstruction_tables.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
