"""Write a solved problem as the artifact `reconstruction`."""

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from pipeline.data import motion, ply
from pipeline.data.motion import TRACKS, Motion
from pipeline.data.templates import SkinTable
from pipeline.data.volumes import FEATURE_VOLUME
from pipeline.fields import fields
from pipeline.fields.fields import Reconstruction
from stages.reconstruct import results
from stages.reconstruct.problem import Problem


def write(
    folder: Path,
    problem: Problem,
    reconstruction: Reconstruction,
    motions: Mapping[str, Motion],
    sessions: Collection[str],
) -> None:
    """Write motion per video (of the templates apart), surfaces, skin, fields, feature volume and track
    points.
    """
    (folder / "templates").mkdir()
    for id, of_video in motions.items():
        if id in sessions:
            (folder / id).mkdir()
            motion.save(folder / id / "motion.npz", of_video)
        else:
            motion.save(folder / "templates" / f"{id}.npz", of_video)
    agent = results.agent_surface(problem)
    ply.write_ply(folder / "scene.ply", results.scene_surface(problem))
    ply.write_ply(folder / "agent.ply", agent)
    body = reconstruction.body
    SkinTable(
        results.skin_weights(problem, agent),
        body.agent_from_bone_rest.cpu().numpy(),
        body.bone_scale_m.detach().cpu().numpy(),
    ).write(folder)
    fields.save(folder, reconstruction)
    volume = results.feature_volume(problem)
    FEATURE_VOLUME.save(
        folder / "feature_volume.npz",
        compress=True,
        features=volume.features,
        occupancy=volume.occupancy,
        origin=volume.origin,
        voxel_m=np.asarray(results.VOXEL_M, np.float64),
    )
    index, rest = results.track_points(agent)
    TRACKS.save(folder / "tracks.npz", vertex_index=index, rest_agent=rest)
