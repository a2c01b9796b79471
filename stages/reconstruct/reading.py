"""Read the inputs of the stage: recordings with their poses, and the agent template."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core import progress, threads
from pipeline.core.errors import InputError
from pipeline.data import features, flow, ply, templates
from pipeline.data.clips import Clip, Masks
from pipeline.data.poses import RegisteredPoses
from pipeline.data.templates import AgentCameras, SceneCameras, SkinTable
from stages.reconstruct.assemble import AgentTemplate, RegisteredVideo
from stages.reconstruct.config import PixelSampling
from stages.reconstruct.rays import RaySource, RayStore, collect, join


@dataclass(frozen=True)
class Inputs:
    """What the stage reads; per-recording folders by id."""

    frames: Mapping[str, Path]
    """of walk-through, turnaround and sessions"""
    masks: Mapping[str, Path]
    flow: Mapping[str, Path]
    features: Mapping[str, Path]
    registration: Path
    scene_template: Path
    agent_template: Path
    former: Path | None = None
    """a reconstruction of the same home to start from"""


@dataclass(frozen=True)
class _Reader:
    """Reads recordings into rays."""

    inputs: Inputs
    sampling: PixelSampling
    seed: int
    scratch: Path | None

    def walkthrough(self, id: str) -> RegisteredVideo:
        """Read the walk-through, in which there is no agent."""
        table, source = SceneCameras.open(self.inputs.scene_template), self._source(id, masked=False)
        cameras = table.world_from_registered
        nowhere, certain = np.full_like(cameras, np.nan), np.ones(len(cameras))
        return RegisteredVideo(
            id, table.timestamp_s, cameras, nowhere, certain, np.zeros(len(cameras), bool),
            camera_free=False, has_scene=True, store=self._rays(id, source), clip=source.clip,
        )  # fmt: skip

    def turnaround(self, id: str) -> RegisteredVideo:
        """Read the turnaround; its world is the agent: the root is the identity where the camera is known."""
        table, source = AgentCameras.open(self.inputs.agent_template), self._source(id, has_scene=False)
        cameras = table.agent_from_registered
        known = np.all(np.isfinite(cameras), axis=(1, 2))
        root = np.where(known[:, None, None], np.eye(4), np.nan)
        return RegisteredVideo(
            id, table.timestamp_s, cameras, root, known.astype(float), known,
            camera_free=False, has_scene=False, store=self._rays(id, source),
        )  # fmt: skip

    def session(self, id: str) -> RegisteredVideo:
        """Read a registered session."""
        table = RegisteredPoses.open(self.inputs.registration / id)
        assert table is not None, f"{id} was refused"
        source = self._source(id)
        return RegisteredVideo(
            id, table.timestamp_s, table.world_from_camera, table.world_from_agent,
            table.confidence, table.agent_visible, camera_free=True, has_scene=True,
            store=self._rays(id, source), clip=source.clip, masks=source.masks,
            agent_confidence=table.agent_confidence,
        )  # fmt: skip

    def _source(self, id: str, has_scene: bool = True, masked: bool = True) -> RaySource:
        clip = Clip.open(self.inputs.frames[id])
        feature = features.open_features(self.inputs.features[id])
        if not masked:
            return RaySource(clip, feature)
        folder = self.inputs.flow[id]
        flows = tuple(
            (gap, flow.open_flow(folder, gap), flow.open_confidence(folder, gap))
            for gap in flow.GAPS
            if flow.path_of(folder, gap).exists()
        )
        return RaySource(clip, feature, Masks.open(self.inputs.masks[id]), flows, has_scene)

    def _rays(self, id: str, source: RaySource) -> RayStore:
        rng = np.random.default_rng([self.seed, *id.encode()])
        return join([collect(source, self.sampling, rng)], self.scratch)


def read_videos(
    inputs: Inputs,
    walkthrough: str,
    turnaround: str,
    sampling: PixelSampling,
    seed: int,
    only: Collection[str | None] | None = None,
    scratch: Path | None = None,
    workers: int = 1,
) -> list[RegisteredVideo]:
    """Read the walk-through, the turnaround and every registered session once into rays with their poses.

    Args:
        only: read only the first registered one of these sessions (of all if none is) and the turnaround.
        scratch: folder of unnamed files with the rays; None: the directory of temporary files.
        workers: sessions read in parallel.

    Raises:
        InputError: RCN-001 when no session was registered.
    """
    registered = inputs.registration
    sessions = [id for id in sorted(inputs.frames) if (registered / id / "poses.npz").exists()]
    sessions = [id for id in sessions if id in (only or ())] or sessions
    if not sessions:
        remedy = "see registration/summary.json for the reasons"
        raise InputError("RCN-001", "no session was registered", str(registered), remedy)
    reader = _Reader(inputs, sampling, seed, scratch)
    if only is not None:
        return [reader.turnaround(turnaround), reader.session(sessions[0])]
    videos = [reader.walkthrough(walkthrough), reader.turnaround(turnaround)]
    read = threads.ordered(reader.session, sessions, workers)
    return videos + list(progress.track(read, "reading sessions", total=len(sessions)))


def read_template(folder: Path) -> AgentTemplate:
    """Read the agent template."""
    skin, feature = SkinTable.open(folder), templates.read_vertex_features(folder)
    mesh = ply.read_ply(folder / "agent.ply")
    return AgentTemplate(mesh, feature, skin.agent_from_bone_rest, skin.bone_scale_m)
