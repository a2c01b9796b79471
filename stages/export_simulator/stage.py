"""Export a reconstruction and its behaviour model as a page, and as animated files for other programs."""

from dataclasses import dataclass
from pathlib import Path

from pipeline.core.videos import Video
from pipeline.data import qa
from stages.export_simulator import export, reading, writing
from stages.export_simulator.config import Config


@dataclass(frozen=True)
class Inputs:
    """Artifacts that the simulator is made of."""

    reconstruction: Path
    splats: Path
    behavior: Path
    behavior_data: Path


def run(inputs: Inputs, config: Config, out: Path, *, videos: tuple[Video, ...] = ()) -> float:
    """Write page, `agent.glb`, `scene.glb`, `skin_8.npz` and `simulator.json` into ``out``; return megabytes
    of the page.

    Raises InputError EXP-001 where no session is long enough, EXP-002 for a model that the page cannot
    sample.
    """
    parts = export.simulator(
        reading.body(inputs.reconstruction),
        reading.scene(inputs.reconstruction),
        reading.gaussians(inputs.splats),
        reading.motions(inputs.behavior_data),
        config,
    )
    assets = reading.behavior_assets(inputs.behavior, inputs.behavior_data)
    labels = {video.id: Path(video.file).stem for video in videos}
    size_mb = writing.write_simulator(out, parts, assets, config.name, config.layout, labels)
    qa.write(out, **writing.quality(parts, size_mb, assets.supported))
    return size_mb
