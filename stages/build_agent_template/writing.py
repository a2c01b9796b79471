"""Write the agent template's files."""

from pathlib import Path

import numpy as np

from pipeline.data import ply
from pipeline.data.clips import Clip
from pipeline.data.templates import AgentCameras, SkinTable, write_vertex_features
from stages.build_agent_template.template import CanonicalTemplate


def write(folder: Path, template: CanonicalTemplate, clip: Clip) -> None:
    """Write the surface, its skin and features, and the cameras around it."""
    ply.write_ply(folder / "agent.ply", template.mesh)
    SkinTable(template.weights, template.bones.agent_from_bone_rest, template.bones.bone_scale_m).write(
        folder
    )
    write_vertex_features(folder, template.features)
    AgentCameras(
        timestamp_s=clip.timestamp_s,
        agent_from_camera=template.agent_from_camera,
        intrinsics=clip.intrinsics,
        registered=np.isfinite(template.agent_from_camera[:, 0, 0]),
    ).write(folder)
