"""Segment the animal in one recording: masks 255 agent, 0 not, 128 unknown; by default without any trained
weights.

Sessions: the animal is what lies in space that other frames saw through, tracked over the whole recording, so
that it is kept while it rests; a small network then learns its appearance and finds it where it never moved.
One that rests all the time is what stands out from the ground where a hint points. Turnaround: it is what
stands on the ground where all cameras look. No map is used. A recording without depth needs a hint and is
followed from there by colour and flow. `--prompt FILE` points at it, in TOML: `frame = 12` or `time_s = 1.2`,
and `box = [x0, y0, x1, y1]` or `click = [x, y]`, in pixels of the stored picture or in shares (0..1) of it.
`make` gives `captures/<agent>/<recording>.prompt.toml`.

    python -m stages.segment_agent --frames build/cat/frames/v002 --flow build/cat/flow/v002 --out masks_v002
"""

from pipeline.workflow import cli
from stages.segment_agent import stage
from stages.segment_agent.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
