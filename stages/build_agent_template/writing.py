"""Write the agent template's files."""

from pathlib import Path

import numpy as np

from pipeline.files import arrays, meshes
from pipeline.files.clips import Clip
from stages.build_agent_template.template import Template


def write(folder: Path, template: Template, clip: Clip) -> None:
    """Write the surface, its skin and features, and the cameras around it."""
    meshes.write_ply(folder / "agent.ply", template.mesh)
    arrays.save(
        folder / "skin.npz",
        weights=template.weights.astype(np.float32),
        agent_from_bone_rest=template.bones.agent_from_bone_rest.astype(np.float32),
        bone_scale_m=template.bones.bone_scale_m.astype(np.float32),
    )
    arrays.save(folder / "vertex_features.npz", features=template.features.astype(np.float16))
    arrays.save(
        folder / "cameras.npz",
        timestamp_s=clip.timestamp_s,
        agent_from_camera=template.agent_from_camera,
        intrinsics=clip.intrinsics,
        registered=np.isfinite(template.agent_from_camera[:, 0, 0]),
    )
