"""Write what was built as files for another program: `make export AGENT=cat FORMAT=usd`.

Reads finished artifacts, computes nothing anew. Formats: glb (Blender, Unity, Unreal, three.js), splats (3D
Gaussian viewers), usd (Omniverse, Isaac, Houdini), bvh (animation tools), mjcf (MuJoCo), tables (pandas, R),
movement and nwb (behavior analysis), nerfstudio and colmap (training of radiance fields). Each writes
`export.json`: the library that wrote it, what is lost in millimeters, and the tool that it was opened with.
`take` adds a generated motion; `body` puts the motions on the body of another build.
"""

from pipeline.workflow import cli
from stages.export import stage
from stages.export.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config, options=("format", "rate_hz"))
