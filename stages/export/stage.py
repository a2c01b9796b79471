"""Write finished artifacts as files for another program."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import assert_never

from pipeline.behavior.perception import FeatureVolume
from stages.export import bvh, cameras, glb, mjcf, neuro, reading, retarget, splats, tables, usd, writing
from stages.export.config import Config


@dataclass(frozen=True)
class Inputs:
    """Artifacts that are exported; `frames` and `masks` have one folder per recording."""

    simulator: Path
    reconstruction: Path
    splats: Path
    behavior_data: Path
    frames: Mapping[str, Path] = field(default_factory=dict)
    masks: Mapping[str, Path] = field(default_factory=dict)
    take: Path | None = None
    body: Path | None = None
    """Artifact `simulator` of another build, whose body takes the motions."""


def run(inputs: Inputs, config: Config, out: Path) -> writing.ExportRecord:
    """Write the format's files and `export.json` into ``out``. Raises EXP-010 where a library is missing."""
    match config.format:
        case "glb":
            record = glb.write(out, _agent(inputs, config), (inputs.simulator / "scene.glb").read_bytes())
        case "splats":
            record = splats.write(out, reading.gaussians(inputs.splats))
        case "usd":
            record = usd.write(out, _agent(inputs, config), reading.room(inputs.simulator))
        case "bvh":
            record = bvh.write(out, _agent(inputs, config))
        case "mjcf":
            record = mjcf.write(
                out, _agent(inputs, config), FeatureVolume.load(inputs.behavior_data / "volume.npz")
            )
        case "tables":
            record = tables.write(out, reading.sessions(inputs.reconstruction))
        case "movement":
            record = neuro.write_movement(out, reading.sessions(inputs.reconstruction))
        case "nwb":
            record = neuro.write_nwb(out, reading.sessions(inputs.reconstruction))
        case "nerfstudio":
            record = cameras.write_nerfstudio(out, _frames(inputs, config))
        case "colmap":
            record = cameras.write_colmap(out, _frames(inputs, config), reading.room(inputs.simulator))
        case _:
            assert_never(config.format)
    writing.write_record(out, config.format, record)
    return record


def _agent(inputs: Inputs, config: Config) -> reading.Agent:
    take = inputs.take / "take.npz" if inputs.take is not None else None
    agent = reading.agent(inputs.simulator, take, config.rate_hz)
    if inputs.body is None:
        return agent
    return retarget.onto(agent, reading.agent(inputs.body, None, config.rate_hz))


def _frames(inputs: Inputs, config: Config) -> list[reading.CameraFrame]:
    per_video = config.pictures_per_video
    return reading.camera_frames(inputs.reconstruction, inputs.frames, inputs.masks, per_video)
