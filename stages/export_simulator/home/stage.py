"""Export the animals of one home as one page."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.core.errors import InputError
from pipeline.core.videos import Video
from pipeline.data import ply, qa
from stages.export_simulator import export, pictures, reading, surfaces, surroundings, writing
from stages.export_simulator.home.config import Config


@dataclass(frozen=True)
class Inputs:
    """Artifacts of every animal, by its name."""

    reconstruction: Mapping[str, Path]
    splats: Mapping[str, Path]
    behavior: Mapping[str, Path]
    behavior_data: Mapping[str, Path]
    home: Path | None = None
    """Folder of another build, in whose home the animals live; with `take`."""
    take: Path | None = None
    """What `simulate` wrote of them in that home."""


def run(inputs: Inputs, config: Config, out: Path, *, videos: tuple[Video, ...] = ()) -> float:
    """Write page and `simulator.json`, the room that of the first animal or that of another build; return the
    page's megabytes.

    Raises EXP-001 where an animal has no session long enough, EXP-002 for a model that the page cannot
    sample, and what `surroundings.of` raises for another home.
    """
    places = {}
    for name in inputs.behavior:
        take = None if inputs.take is None else inputs.take / name
        if take is not None and not take.is_dir():
            continue  # it was absent
        made = inputs.reconstruction[name], inputs.splats[name], inputs.behavior_data[name]
        places[name] = surroundings.of(*made, inputs.home, take, name)
    if not places:
        raise InputError("EXP-003", "holds no take", str(inputs.take), surroundings.REMEDY)
    first = next(iter(places.values()))
    surface, animals = ply.read_ply(first.surface), {}
    for name, place in places.items():
        parts = export.simulator(
            reading.body(inputs.reconstruction[name]),
            surface,
            reading.gaussians(first.splats, inputs.splats[name]),
            place.motions,
            config,
        )
        behavior = reading.behavior_assets(inputs.behavior[name], place.volume, place.roots_world)
        animals[name] = (parts, behavior)
    room = next(iter(animals.values()))[0].scene
    been = np.concatenate([place.roots_world for place in places.values()])
    setting = surfaces.extent(room, been)
    animals = {name: (replace(parts, setting=setting), assets) for name, (parts, assets) in animals.items()}
    labels = {video.id: Path(video.file).stem for video in videos} | first.labels
    remarks = {name: place.remark for name, place in places.items()}
    sizes_mb = writing.write_home(out, animals, config, labels, remarks)
    sheets = {name: pictures.visits(room, setting.floor_m, places[name].motions) for name in animals}
    qa.write(
        out,
        good="the page opens within seconds and shows every animal in the same room",
        bad="an animal that floats or stands in a wall, or a page too big to send",
        checks=writing.page_checks(sizes_mb, len(animals)),
        pictures=[
            qa.Picture(f"visits_{name}", sheet, f"where {name} (amber) and the person (blue) have been")
            for name, sheet in sheets.items()
        ],
    )
    return sum(sizes_mb.values())
