"""Export a reconstruction and its behavior model as a page, and as animated files for other programs."""

from dataclasses import dataclass
from pathlib import Path

from pipeline.core.videos import Video
from pipeline.data import ply, qa
from stages.export_simulator import export, reading, surroundings, writing
from stages.export_simulator.config import Config


@dataclass(frozen=True)
class Inputs:
    """Artifacts that the simulator is made of."""

    reconstruction: Path
    splats: Path
    behavior: Path
    behavior_data: Path
    home: Path | None = None
    """Folder of another build, in whose home the animal lives; with `take`."""
    take: Path | None = None
    """What `simulate` wrote of the animal in that home."""


def run(inputs: Inputs, config: Config, out: Path, *, videos: tuple[Video, ...] = ()) -> float:
    """Write page, `agent.glb`, `scene.glb`, `simulator.json`; return the page's megabytes.

    Raises EXP-001 where no session is long enough, EXP-002 for a model that cannot be sampled, EXP-003 for
    another home without a take in it, ART-003 where that home lacks its surfaces.
    """
    made = inputs.reconstruction, inputs.splats, inputs.behavior_data
    place = surroundings.of(*made, inputs.home, inputs.take, config.name)
    parts = export.simulator(
        reading.body(inputs.reconstruction),
        ply.read_ply(place.surface),
        reading.gaussians(place.splats, inputs.splats),
        place.motions,
        config,
    )
    assets = reading.behavior_assets(inputs.behavior, place.volume, place.roots_world)
    labels = {video.id: Path(video.file).stem for video in videos} | place.labels
    sizes_mb = writing.write_simulator(out, parts, assets, config, labels, place.remark)
    qa.write(out, **writing.quality(parts, sizes_mb, assets.supported))
    return sum(sizes_mb.values())
