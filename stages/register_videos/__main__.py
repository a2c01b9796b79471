"""Register one session's cameras to the scene, and the animal's root poses to the world.

Localized frames vote for the transform of the whole recording; odometry, votes, depth, optical flow and
features then align all frames jointly; the animal is placed in every frame that shows it. Writes poses.npz
and status.json; a rejected recording has no poses.npz, and status.json gives the reason.
"""

from pipeline.workflow import cli
from stages.register_videos import stage
from stages.register_videos.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
