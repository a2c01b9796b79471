"""Which kind of recording it is, and how each becomes a `Life`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import InputError
from pipeline.files import arrays
from pipeline.models.perception import FeatureVolume
from pipeline.space import rigid
from stages.read_trajectories import captured, obstacles, tables
from stages.read_trajectories.captured import Skeleton
from stages.read_trajectories.life import Life, nobody, one_after_another

LIFE = ("timestamp_s", "world_from_agent", "agent_from_bone", "world_from_camera", "agent_from_bone_rest")
FLOOR_QUANTILE = 0.002
FURTHEST_M = 10_000.0
"""Further from the origin single precision tells no more than millimetres, of which walks are made."""


@dataclass(frozen=True)
class Reading:
    """How tables are to be understood; see the stage's configuration."""

    skeleton: Skeleton
    cell_m: float
    obstacle_top_m: float


def read(path: Path, reading: Reading) -> Life:
    """Read a recording of any kind. Raises TRJ-001, TRJ-002."""
    life = _read(path, reading)
    away = np.abs(life.world_from_agent[:, [0, 2], 3])
    if np.nanmax(away) > FURTHEST_M:
        what = f"the animal is up to {np.nanmax(away) / 1000:.0f} km away from the origin"
        raise InputError("TRJ-001", what, str(path), "write metres; subtract one origin near the animal from all x and z")
    return life


def _read(path: Path, reading: Reading) -> Life:
    if path.is_dir():
        return _from_csv(path / "trajectory.csv", path / "obstacles.csv", reading)
    if path.suffix.lower() == ".csv":
        return _from_csv(path, None, reading)
    try:
        stored = arrays.load(path)
    except InputError as error:
        raise InputError("TRJ-001", error.what, str(path), "save it again with numpy.savez, arrays of numbers only") from error
    return _from_life(stored) if set(LIFE) <= set(stored) else _from_joints(path, stored, reading.skeleton)


def _from_csv(path: Path, map_path: Path | None, reading: Reading) -> Life:
    time, agent, camera = tables.motion_from_csv(path)
    seen = agent[np.isfinite(agent).all((1, 2)), :3, 3]
    if not len(seen):
        raise InputError("TRJ-002", "holds no position of the animal", str(path), "fill x, y, z and heading")
    volume = obstacles.no_scene()
    if map_path is not None and map_path.is_file():
        volume = obstacles.volume_from_csv(map_path, seen, reading.cell_m, reading.obstacle_top_m)
    bones = np.tile(np.eye(4), (len(time), 1, 1, 1))
    return Life(time, agent, bones, camera, np.eye(4, dtype=np.float32)[None], volume)


def _from_life(stored: dict[str, np.ndarray]) -> Life:
    names = FeatureVolume.__dataclass_fields__
    volume = {name: stored[f"volume/{name}"] for name in names}
    return Life(**{name: stored[name] for name in LIFE}, volume=FeatureVolume(**volume | {"voxel_m": float(volume["voxel_m"])}))


def _from_joints(path: Path, stored: dict[str, np.ndarray], skeleton: Skeleton) -> Life:
    """Put the clips of a motion capture one after another; the lowest joint touches the floor at y = 0."""
    clips = [np.asarray(clip, float) if clip.dtype.kind in "fiu" else np.zeros(0) for clip in stored.values()]
    fitting = [clip.ndim == 3 and clip.shape[1:] == clips[0].shape[1:] and clip.shape[2] == 3 and len(clip) > 0 for clip in clips]
    if not clips or not all(fitting):
        what = f"arrays {', '.join(f'{name} {value.shape}' for name, value in stored.items())} are no joint positions"
        raise InputError("TRJ-001", what, str(path), "store [frame joint 3] in metres, +y up, one array per clip")
    joints = np.concatenate(clips)
    if not np.isfinite(joints).all():
        raise InputError("TRJ-001", "some joints are not finite", str(path), "leave out frames in which a joint is not known")
    if skeleton.root == skeleton.front or not {skeleton.root, skeleton.front} <= set(range(joints.shape[1])):
        raise InputError("TRJ-001", f"has {joints.shape[1]} joints", str(path), "set root_joint and front_joint in the recipe")
    joints = joints - [0.0, np.quantile(joints[..., 1].min(1), FLOOR_QUANTILE), 0.0]
    agent = captured.root_from_joints(joints, skeleton)
    bones, rest = captured.bones_from_joints(rigid.apply(rigid.inverse(agent), joints), captured.parents(joints, skeleton.root))
    time = one_after_another([np.arange(len(clip)) / skeleton.rate_hz for clip in clips])
    return Life(time, agent, bones, nobody(len(time)), rest.astype(np.float32), obstacles.no_scene())
