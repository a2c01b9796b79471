"""Recognize the format of a table of motion and read it into a `MeasuredMotion`."""

from pathlib import Path

import numpy as np

from pipeline.behavior.perception import FeatureVolume
from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.geometry import rigid
from stages.read_trajectories import captured, obstacles, tables
from stages.read_trajectories.config import Config
from stages.read_trajectories.motion import MeasuredMotion, absent_observer, concatenated_times

MOTION_KEYS = (
    "timestamp_s", "world_from_agent", "agent_from_bone", "world_from_camera", "agent_from_bone_rest",
)  # fmt: skip
VOLUME_KEYS = ("volume/features", "volume/occupancy", "volume/origin", "volume/voxel_m")
MAX_BYTES = 2 << 30  # limit for all arrays of a file, which are read at once
FLOOR_QUANTILE = 0.002
MAX_DISTANCE_M = 10_000.0
"""Maximum distance from the origin: beyond it float32 resolves only millimeters."""


def read(path: Path, config: Config) -> MeasuredMotion:
    """Read a recording of any kind. Raises TRJ-001, TRJ-002."""
    motion = _read(path, config)
    for who, pose in (("the animal", motion.world_from_agent), ("the observer", motion.world_from_camera)):
        away_m = float(np.nanmax(np.abs(pose[:, :3, 3]), initial=0.0))
        if away_m > MAX_DISTANCE_M:
            what = f"{who} is up to {away_m / 1000:.4g} km away from the origin"
            remedy = "write meters; subtract one origin near the animal from all positions"
            raise InputError("TRJ-001", what, str(path), remedy)
    return motion


def _read(path: Path, config: Config) -> MeasuredMotion:
    if path.is_dir():
        return _from_csv(path / "trajectory.csv", path / "obstacles.csv", config)
    if path.suffix.lower() == ".csv":
        return _from_csv(path, None, config)
    try:
        stored = npz.load(path, most=MAX_BYTES)
    except InputError as error:
        remedy = "save it again with numpy.savez, arrays of numbers only"
        raise InputError("TRJ-001", error.what, str(path), remedy) from error
    return _from_life(path, stored) if set(MOTION_KEYS) <= set(stored) else _from_joints(path, stored, config)


def _from_csv(path: Path, map_path: Path | None, config: Config) -> MeasuredMotion:
    time, agent, camera, companions = tables.motion_from_csv(path)
    seen = agent[np.isfinite(agent).all((1, 2)), :3, 3]
    if not len(seen):
        raise InputError("TRJ-002", "holds no position of the animal", str(path), "fill x, y, z and heading")
    volume = obstacles.no_scene()
    if map_path is not None and map_path.is_file():
        volume = obstacles.volume_from_csv(map_path, seen, config.cell_m)
    bones = np.tile(np.eye(4), (len(time), 1, 1, 1))
    rest = np.eye(4, dtype=np.float32)[None]
    return MeasuredMotion(time, agent, bones, camera, rest, volume, companions)


def _from_life(path: Path, stored: dict[str, np.ndarray]) -> MeasuredMotion:
    motion = {name: stored[name] for name in MOTION_KEYS}
    frames, bones = (motion[name].shape[:1] for name in ("timestamp_s", "agent_from_bone_rest"))
    shapes = frames, (*frames, 4, 4), (*frames, *bones, 4, 4), (*frames, 4, 4), (*bones, 4, 4)
    if not (frames and tuple(a.shape for a in motion.values()) == shapes and set(VOLUME_KEYS) <= set(stored)):
        what = "has arrays of a life missing or of other shapes"
        remedy = "see data_layout.md, synthetic_lives"
        raise InputError("TRJ-001", what, str(path), remedy)
    features, occupancy, origin, voxel_m = (stored[name] for name in VOLUME_KEYS)
    volume = FeatureVolume(features, occupancy, origin, float(voxel_m))
    return MeasuredMotion(**motion, volume=volume, companions=stored.get("companions"))


def _from_joints(path: Path, stored: dict[str, np.ndarray], config: Config) -> MeasuredMotion:
    """Concatenate the clips of a motion capture; the lowest joint touches the floor at y = 0."""
    clips: list[np.ndarray] = [
        np.asarray(clip, float) if clip.dtype.kind in "fiu" else np.zeros(0) for clip in stored.values()
    ]
    fitting = [
        clip.ndim == 3 and clip.shape[1:] == clips[0].shape[1:] and clip.shape[2] == 3 and len(clip) > 0
        for clip in clips
    ]
    if not clips or not all(fitting):
        shapes = ", ".join(f"{name} {value.shape}" for name, value in stored.items())
        remedy = "store [frame joint 3] in meters, +y up, one array per clip"
        raise InputError("TRJ-001", f"arrays {shapes} are no joint positions", str(path), remedy)
    joints = np.concatenate(clips)
    if not np.isfinite(joints).all():
        remedy = "leave out frames in which a joint is not known"
        raise InputError("TRJ-001", "some joints are not finite", str(path), remedy)
    named = {config.root_joint, config.front_joint}
    if len(named) < 2 or not named <= set(range(joints.shape[1])):
        remedy = "set root_joint and front_joint in the recipe"
        raise InputError("TRJ-001", f"has {joints.shape[1]} joints", str(path), remedy)
    joints = joints - [0.0, np.quantile(joints[..., 1].min(1), FLOOR_QUANTILE), 0.0]
    agent = captured.root_from_joints(joints, config)
    parents = captured.parents(joints, config.root_joint)
    bones, rest = captured.bones_from_joints(rigid.apply(rigid.inverse(agent), joints), parents)
    time = concatenated_times([np.arange(len(clip)) / config.rate_hz for clip in clips])
    nobody, scene = absent_observer(len(time)), obstacles.no_scene()
    return MeasuredMotion(time, agent, bones, nobody, rest.astype(np.float32), scene)
