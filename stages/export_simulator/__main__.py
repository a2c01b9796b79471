"""Make the simulator: one page that opens by itself, and animated files for other programs.

Reads `reconstruction`, `splats`, `behavior` and `behavior_data`. Writes `index.html` (the page: room, animal, the
three diffusion models, everything embedded; nothing is requested), `agent.glb` (skinned, with every recorded
session as an animation), `scene.glb` and `simulator.json` (what any other player must know).
"""

from dataclasses import dataclass

from pipeline import cli, qa
from pipeline.cli import Task
from stages.export_simulator import export, reading, writing


@dataclass(frozen=True)
class Config:
    """How light the page has to be."""

    name: str = "the animal"
    """what the page calls it"""
    scene_faces: int = 40_000
    """triangles kept of the room"""
    agent_faces: int = 12_000
    """triangles kept of the animal"""
    scene_splats: int = 150_000
    """Gaussians kept of the room, the faintest go first"""
    agent_splats: int = 20_000
    """Gaussians kept of the animal"""
    layout: writing.Layout = "file"
    """one page that opens from the disk, or a folder for big scenes that wants a static host"""
    fitted_poses: int = 48
    """recorded poses, as different as can be, that the four skinning weights are fitted to"""
    action_rate_hz: float = 30.0
    """keys of the animations in `agent.glb`"""
    warn_page_mb: float = 30.0
    """megabytes above which the report warns about the page"""


def run(task: Task) -> None:
    """Open, thin, fit, resample, pack, write."""
    reconstruction, behavior_data = task.input("reconstruction"), task.input("behavior_data")
    made = export.simulator(
        reading.body(reconstruction),
        reading.scene(reconstruction),
        reading.gaussians(task.input("splats")),
        reading.motions(behavior_data),
        task.config,
    )
    minds = reading.minds(task.input("behavior"), behavior_data)
    with task.create() as folder:
        size_mb = writing.write_simulator(folder, made, minds, task.config.name, task.config.layout)
        qa.write(folder, **writing.quality(made, size_mb, task.config.warn_page_mb))


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("reconstruction", "splats", "behavior", "behavior_data"))
