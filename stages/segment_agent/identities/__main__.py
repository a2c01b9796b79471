"""Train the network that distinguishes the animals of a home, on all their turnarounds.

It classifies pixels; `segment_agent` uses it to identify what moves.

    python -m stages.segment_agent.identities --frames build/pair/frames --flow build/pair/flow \\
        --videos build/pair/plan/videos.json --out build/pair/identities
"""

from pipeline.workflow import cli
from stages.segment_agent.identities import stage
from stages.segment_agent.identities.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
