"""Register one session to the scene and the animal's roots to the world.

Frames are localized and vote for one motion of the whole recording; odometry, votes, depth, optical flow and
features then align all frames at once; the animal is placed in every frame that shows it. Writes poses.npz
and status.json; a recording that does not fit has no poses.npz, and status.json gives the reason.
"""

from pipeline.workflow import cli
from stages.register_videos import stage
from stages.register_videos.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
