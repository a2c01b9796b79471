"""Build the canonical animal from the recording that circles it: closed surface, 25 bones, features, cameras.

Drift of the phone's poses is corrected and the loop closed, masked depth is fused and carved, and the body is
divided into Gaussian bones. Where the turntable in the report does not begin with the head, `turn_deg` in the
recipe turns the animal: 180 where head and tail were confused.

    python -m stages.build_agent_template --frames build/cat/frames --masks build/cat/masks \\
        --features build/cat/features --videos build/cat/plan/videos.json --out build/cat/agent_template
"""

from pipeline.workflow import cli
from stages.build_agent_template import stage
from stages.build_agent_template.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
