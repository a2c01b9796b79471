"""Write what was built as files for another program: `make export AGENT=cat FORMAT=usd`.

Reads finished artifacts, computes nothing anew. Formats: glb (Blender, Unity, Unreal, three.js), splats (3D Gaussian
viewers), usd (Omniverse, Isaac, Houdini), bvh (animation tools), mjcf (MuJoCo), tables (pandas, R), movement and nwb
(behaviour analysis), nerfstudio and colmap (training of radiance fields). Each writes `export.json`: the library that
wrote it, what is lost in millimetres, and the tool that it was opened with. `take` adds a generated motion.
"""

from dataclasses import dataclass
from typing import Literal, assert_never

from pipeline import cli
from pipeline.cli import Task
from stages.export import bvh, cameras, glb, mjcf, neuro, reading, splats, tables, usd, writing

Format = Literal["glb", "splats", "usd", "bvh", "mjcf", "tables", "movement", "nwb", "nerfstudio", "colmap"]


@dataclass(frozen=True)
class Config:
    """What is written."""

    format: Format = "glb"
    """one of the formats above"""
    rate_hz: float = 30.0
    """keys of animations"""
    influences: reading.Influences = "4"
    """bones that move a vertex in glb and usd: four, which every player blends, or eight, a little nearer"""
    pictures_per_video: int = 150
    """frames of each recording that nerfstudio and colmap get, evenly spread; these two formats alone hold pictures"""
    colmap_points: int = 20_000
    """points of the room in the colmap model"""


def run(task: Task) -> None:
    """Open, convert, write."""
    c: Config = task.config
    with task.create() as folder:
        match c.format:
            case "glb":
                told = glb.write(folder, _agent(task), (task.input("simulator") / "scene.glb").read_bytes())
            case "splats":
                told = splats.write(folder, reading.gaussians(task.input("splats")))
            case "usd":
                told = usd.write(folder, _agent(task), reading.room(task.input("simulator")))
            case "bvh":
                told = bvh.write(folder, _agent(task))
            case "mjcf":
                told = mjcf.write(folder, _agent(task), reading.occupancy(task.input("behavior_data")))
            case "tables":
                told = tables.write(folder, _sessions(task))
            case "movement":
                told = neuro.write_movement(folder, _sessions(task))
            case "nwb":
                told = neuro.write_nwb(folder, _sessions(task))
            case "nerfstudio" | "colmap":
                shots = _shots(task)
                write = cameras.write_nerfstudio if c.format == "nerfstudio" else cameras.write_colmap
                told = write(folder, shots, reading.room(task.input("simulator")), c.colmap_points)
            case _:
                assert_never(c.format)
        writing.tell(folder, c.format, told)


def _agent(task: Task) -> reading.Agent:
    take = task.input("take") / "take.npz" if task.has("take") else None
    return reading.agent(task.input("simulator"), take, task.config.rate_hz, task.config.influences)


def _sessions(task: Task) -> list[reading.Session]:
    return reading.sessions(task.input("reconstruction"))


def _shots(task: Task) -> list[reading.Shot]:
    return reading.shots(task.input("reconstruction"), task.per_video("frames"), task.per_video("masks"), task.config.pictures_per_video)


if __name__ == "__main__":
    reads = ("simulator", "reconstruction", "splats", "behavior_data", "frames", "masks")
    cli.enter(__doc__, run, config=Config, reads=reads, optional=("take",), options=("format", "rate_hz", "influences"))
