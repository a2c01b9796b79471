"""Build the canonical animal from the recording that circles it: closed surface, 25 bones, features, cameras.

Drift of the camera poses is corrected with loop closure, masked depth is fused and carved by silhouettes, and
the body is divided into Gaussian bones. If the turntable in the report does not begin with the head, set
`turn_deg` in the recipe: 180 if head and tail were confused.

    python -m stages.build_agent_template --frames build/cat/frames --masks build/cat/masks \\
        --features build/cat/features --videos build/cat/plan/videos.json --out build/cat/agent_template
"""

from pipeline.workflow import cli
from stages.build_agent_template import stage
from stages.build_agent_template.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
