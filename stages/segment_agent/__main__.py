"""Segment the animal in one recording: masks 255 agent, 0 not, 128 unknown; by default without any trained
weights.

Sessions: the animal occupies space that other frames saw through. It is tracked over the whole recording, so
rests are covered too; a small network then learns its appearance and finds it where it never moved. If it
rests all the time, it is segmented from the ground where a prompt points. Turnaround: the animal stands on
the ground where the optical axes meet. No map is used. In a build, recordings without depth have it from
`estimated_frames`; frames without any depth, given by hand, need a prompt, whose mask is propagated by color
and flow. `--prompt FILE` gives the prompt in TOML: `frame = 12` or `time_s = 1.2`, and
`box = [x0, y0, x1, y1]` or `click = [x, y]`, in pixels of the stored picture or as fractions (0..1) of it.
`make` passes `captures/<agent>/<recording>.prompt.toml`.

    python -m stages.segment_agent --frames build/cat/frames/v002 --flow build/cat/flow/v002 --out masks_v002
"""

from pipeline.workflow import cli
from stages.segment_agent import stage
from stages.segment_agent.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
