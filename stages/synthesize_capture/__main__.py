"""Film the built-in world: a furnished room with a cat that reacts to people, as Record3D recordings.

Writes `recordings/` (walk-through, turnaround, sessions, a second phone for one session) and, apart
from them, `truth/`, which only `evaluate` may read. No real animal is needed to run the whole flow.
"""

from pipeline.workflow import cli
from stages.synthesize_capture import stage
from stages.synthesize_capture.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
