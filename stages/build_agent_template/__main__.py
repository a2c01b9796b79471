"""Build the canonical animal from the recording that circles it: closed surface, 25 bones, features, cameras.

The phone's poses are freed of drift and the circle is closed, masked depth is fused and carved, and the body's cells
are divided into Gaussian bones along the limbs. Where the turntable in the report does not begin with the head's side,
`turn_deg` in the recipe turns the animal: 180 when head and tail were mistaken for each other.

    python -m stages.build_agent_template --frames build/cat/frames --masks build/cat/masks --features build/cat/features \\
        --videos build/cat/plan/videos.json --out build/cat/agent_template
"""

from dataclasses import dataclass

import numpy as np

from pipeline import cli, qa
from pipeline.files import arrays
from pipeline.files.clips import Clip, Masks
from pipeline.progress import log
from stages.build_agent_template import pictures, writing
from stages.build_agent_template.template import Options, build


@dataclass(frozen=True)
class Config(Options):
    """Options of this stage."""

    seed: int = 0
    """Seed of the random numbers."""


def run(task: cli.Task) -> None:
    """Build the template from the turnaround and write it."""
    folders = {name: task.per_video(name, roles=("turnaround",)) for name in ("frames", "masks", "features")}
    video = next(iter(folders["frames"]))
    if len(folders["frames"]) > 1:
        log(f"several turnarounds: {video} is used")
    clip, masks = Clip.open(folders["frames"][video]), Masks.open(folders["masks"][video])
    features = arrays.open_lazily(folders["features"][video] / "features.npz", "features")
    template = build(clip, masks, features, task.config, np.random.default_rng(task.config.seed))
    log(f"surface: {len(template.mesh.vertices)} vertices from {template.around_deg:.0f} deg around")
    log(f"depth pictures agree within {1000 * template.residual_m:.0f} mm")
    checks, shown = pictures.report(template)
    with task.create() as folder:
        writing.write(folder, template, clip)
        qa.write(
            folder,
            good="a whole animal, closed, with thin legs and tail, and one hue per limb",
            bad="a body with a hull of floor, doubled limbs, or one hue over several limbs",
            checks=checks,
            pictures=shown,
        )


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("frames", "masks", "features"))
