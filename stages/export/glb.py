"""glTF binary: the skinned animal with all motions as named actions, and the room."""

import io
from pathlib import Path

import trimesh

from pipeline.data import glb
from stages.export.reading import Agent
from stages.export.writing import ExportRecord, version


def write(folder: Path, agent: Agent, scene: bytes) -> ExportRecord:
    """Write `agent.glb` and `scene.glb`."""
    data = glb.skinned(agent.mesh, agent.skin, agent.actions)
    (folder / "agent.glb").write_bytes(data)
    (folder / "scene.glb").write_bytes(scene)
    for content in (data, scene):
        opened = trimesh.load_scene(io.BytesIO(content), file_type="glb")
        assert len(opened.geometry) == 1, "one surface a file"
    remark = "meters, +y up; joints are siblings under one root; 4 influences a vertex; one action per motion"
    return ExportRecord(version("pygltflib"), agent.loss_mm, version("trimesh"), remark)
