"""Turn one phone recording into upright frames at 10 Hz with metric depth, intrinsics and odometry.

Reads Record3D (`.r3d`, EXR + JPG), Stray Scanner, Polycam raw data, NeRFCapture streams, TUM and 7-Scenes
folders, and video with depth pictures. Checks on the depth what the device poses mean. A walk-through
that is a video alone is mapped from its pictures; sessions with depth supply scale, otherwise its scale
is relative. Of a session or turnaround without depth the pictures alone are kept, for `estimate_depth`.
"""

from pipeline.workflow import cli
from stages.extract_frames import stage
from stages.extract_frames.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
