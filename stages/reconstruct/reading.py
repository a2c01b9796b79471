"""Open what the stage reads: the recordings with their poses, and the agent template."""

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline import progress, threads
from pipeline.errors import InputError
from pipeline.files import arrays, meshes
from pipeline.files.clips import Clip, Masks
from stages.reconstruct.assemble import Template, Video
from stages.reconstruct.rays import Sampling, Source, collect, join

FLOW_GAPS = (1, 2, 4, 8)


@dataclass(frozen=True)
class Folders:
    """Where the inputs stand; per-recording ones by id."""

    frames: Mapping[str, Path]
    masks: Mapping[str, Path]
    flow: Mapping[str, Path]
    features: Mapping[str, Path]
    registration: Path
    scene_template: Path
    agent_template: Path
    scratch: Path | None = None
    """where unnamed files with what was read may stand; None: where temporary files do"""


def read_videos(
    folders: Folders,
    walkthrough: str,
    turnaround: str,
    sampling: Sampling,
    seed: int,
    only: Collection[str | None] | None = None,
    workers: int = 1,
) -> list[Video]:
    """Read the walk-through, the turnaround and every registered session once into rays with their poses.

    With ``only``, the first registered one of these sessions, of all where it is empty, stands alone, with the turnaround that
    made its template.
    So many ``workers`` read sessions at once.
    Raises `InputError` RCN-001 when no session was registered.
    """
    sessions = [id for id in sorted(folders.frames) if (folders.registration / id / "poses.npz").exists() and (not only or id in only)]
    if not sessions:
        raise InputError("RCN-001", "no session was registered", str(folders.registration), "see registration/summary.json for the reasons")
    if only is not None:
        return [_turnaround(turnaround, folders, sampling, seed), _session(sessions[0], folders, sampling, seed)]
    videos = [_walkthrough(walkthrough, folders, sampling, seed), _turnaround(turnaround, folders, sampling, seed)]
    read = threads.ordered(lambda id: _session(id, folders, sampling, seed), sessions, workers)
    return videos + list(progress.track(read, "reading sessions", total=len(sessions)))


def _walkthrough(id: str, folders: Folders, sampling: Sampling, seed: int) -> Video:
    table = arrays.load(folders.scene_template / "cameras.npz")
    cameras = np.where(table["registered"][:, None, None], table["world_from_camera"], np.nan)
    source = Source(Clip.open(folders.frames[id]), _features(folders, id))
    nowhere, nothing = np.full_like(cameras, np.nan), np.zeros(len(cameras), bool)
    store = join([collect(source, sampling, _rng(seed, id))], folders.scratch)
    return Video(
        id,
        table["timestamp_s"],
        cameras,
        nowhere,
        np.ones(len(cameras)),
        nothing,
        camera_free=False,
        has_scene=True,
        store=store,
        source=source,
    )


def _turnaround(id: str, folders: Folders, sampling: Sampling, seed: int) -> Video:
    """Read the turnaround; its world is the agent, so the root is the identity wherever the camera is known."""
    table = arrays.load(folders.agent_template / "cameras.npz")
    cameras = np.where(table["registered"][:, None, None], table["agent_from_camera"], np.nan)
    known = np.isfinite(cameras).all((1, 2))
    root = np.where(known[:, None, None], np.eye(4), np.nan)
    store = join([collect(_masked(id, folders, has_scene=False), sampling, _rng(seed, id))], folders.scratch)
    return Video(id, table["timestamp_s"], cameras, root, known.astype(float), known, camera_free=False, has_scene=False, store=store)


def _session(id: str, folders: Folders, sampling: Sampling, seed: int) -> Video:
    table, source = arrays.load(folders.registration / id / "poses.npz"), _masked(id, folders, has_scene=True)
    store = join([collect(source, sampling, _rng(seed, id))], folders.scratch)
    return Video(
        id,
        table["timestamp_s"],
        table["world_from_camera"],
        table["world_from_agent"],
        table["confidence"],
        table["agent_visible"],
        camera_free=True,
        has_scene=True,
        store=store,
        source=source,
        agent_confidence=table["agent_confidence"],
    )


def _masked(id: str, folders: Folders, has_scene: bool) -> Source:
    flows = []
    for gap in FLOW_GAPS:
        path = folders.flow[id] / f"flow_{gap}_fw.npz"
        if path.exists():
            flows.append((gap, arrays.open_lazily(path, "flow"), arrays.open_lazily(path, "confidence")))
    return Source(Clip.open(folders.frames[id]), _features(folders, id), Masks.open(folders.masks[id]), tuple(flows), has_scene)


def _features(folders: Folders, id: str) -> np.ndarray:
    return arrays.open_lazily(folders.features[id] / "features.npz", "features")


def _rng(seed: int, id: str) -> np.random.Generator:
    return np.random.default_rng([seed, *id.encode()])


def read_template(folder: Path) -> Template:
    """Read the agent template."""
    skin, feature = arrays.load(folder / "skin.npz"), arrays.load(folder / "vertex_features.npz")["features"]
    return Template(meshes.read_ply(folder / "agent.ply"), feature, skin["agent_from_bone_rest"], skin["bone_scale_m"])


def read_floor(folder: Path) -> float:
    """Read the floor's height in the world, metres."""
    return float(json.loads((folder / "world.json").read_text())["floor"])
