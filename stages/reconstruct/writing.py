"""Write a solved problem as the artifact `reconstruction`."""

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from pipeline.files import arrays, meshes
from pipeline.models import fields, motion
from pipeline.models.fields import Reconstruction
from pipeline.models.motion import Motion
from pipeline.space.meshes import Mesh
from stages.reconstruct import results
from stages.reconstruct.problem import Problem


def write(
    folder: Path,
    problem: Problem,
    reconstruction: Reconstruction,
    motions: Mapping[str, Motion],
    sessions: Collection[str],
    scene: Mesh,
    agent: Mesh,
) -> None:
    """Write motion per video (those of the templates apart), surfaces, skin, fields, feature volume and track points."""
    (folder / "templates").mkdir()
    for id, found in motions.items():
        if id in sessions:
            (folder / id).mkdir()
        motion.save(folder / id / "motion.npz" if id in sessions else folder / "templates" / f"{id}.npz", found)
    meshes.write_ply(folder / "scene.ply", scene)
    meshes.write_ply(folder / "agent.ply", agent)
    body = reconstruction.body
    arrays.save(
        folder / "skin.npz",
        weights=results.skin_weights(problem, agent).astype(np.float32),
        agent_from_bone_rest=body.agent_from_bone_rest.cpu().numpy().astype(np.float32),
        bone_scale_m=body.bone_scale_m.detach().cpu().numpy().astype(np.float32),
    )
    fields.save(folder, reconstruction)
    volume = results.feature_volume(problem)
    arrays.save(
        folder / "feature_volume.npz",
        compress=True,
        features=volume.features,
        occupancy=volume.occupancy,
        origin=volume.origin,
        voxel_m=np.float64(results.VOXEL_M),
    )
    index, rest = results.track_points(agent)
    arrays.save(folder / "tracks.npz", vertex_index=index.astype(np.int64), rest_agent=rest.astype(np.float32))
