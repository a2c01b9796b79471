"""Turn a reconstruction and its recordings into the parts of a simulator: light, re-fitted, resampled."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.data.glb import Action, Skin
from pipeline.fields import weight_refit
from pipeline.fields.skinning import SkinnedShape
from pipeline.geometry.decimation import decimate
from pipeline.geometry.meshes import Mesh
from pipeline.geometry.subsampling import evenly
from pipeline.longterm.bodies import SkinnedBody
from stages.export_simulator import surfaces
from stages.export_simulator.actions import SessionClip, animation
from stages.export_simulator.config import Config
from stages.export_simulator.reading import SplatClouds

FITTED_POSES = 48
"""Recorded poses, as different as can be, that weights are fitted to: more change the loss by under 1 %."""
ACTION_RATE_HZ = 30.0
"""Keys of the animations in `agent.glb`: what players interpolate without visible steps."""
_JUDGED_POSES = 200
"""Other poses at which the fit is measured."""


@dataclass(frozen=True)
class SimulatorParts:
    """The parts of a simulator."""

    agent: Mesh
    skin: Skin
    residual_m: Float[np.ndarray, "frame vertex"]
    """distance of the four-weight linear blend from dual-quaternion blending, poses that were not fitted"""
    actions: list[Action]
    scene: Mesh
    splat_rows: bytes
    agent_splats: surfaces.SkinnedSplats
    setting: surfaces.RoomExtent
    motions: list[SessionClip]


def simulator(
    body: SkinnedBody, scene: Mesh, gaussians: SplatClouds, motions: list[SessionClip], config: Config
) -> SimulatorParts:
    """Thin the surfaces, fit the weights, resample the motion."""
    agent, source_vertex = decimate(body.mesh, config.agent_faces)
    thinned = replace(body, mesh=agent, weights=body.weights[source_vertex])
    skin, residual_m = fit_weights(thinned, motions)
    room, _ = decimate(scene, config.scene_faces)
    inside = np.concatenate([motion.world_from_camera[:, :3, 3] for motion in motions]).mean(0)
    positions = np.concatenate([motion.world_from_agent[:, :3, 3] for motion in motions])
    return SimulatorParts(
        agent=agent,
        skin=skin,
        residual_m=residual_m,
        actions=[animation(motion, ACTION_RATE_HZ) for motion in motions],
        scene=surfaces.orient_towards(room, inside),
        splat_rows=surfaces.splat_rows(gaussians.scene, config.scene_splats),
        agent_splats=surfaces.skinned_splats(gaussians.agent, gaussians.agent_weights, config.agent_splats),
        setting=surfaces.extent(room, positions),
        motions=motions,
    )


def fit_weights(
    body: SkinnedBody, motions: list[SessionClip]
) -> tuple[Skin, Float[np.ndarray, "frame vertex"]]:
    """Fit four weights a vertex to recorded poses that differ most.

    Returns them with the distance, meters, that they leave in poses that were not fitted.
    """
    recorded = np.concatenate([motion.agent_from_bone for motion in motions])
    chosen = weight_refit.farthest_poses(recorded, FITTED_POSES)
    others = np.setdiff1d(np.arange(len(recorded)), chosen)
    judged = others[evenly(len(others), _JUDGED_POSES)] if len(others) else chosen
    vertices = body.mesh.vertices.astype(np.float64)
    shape = SkinnedShape(vertices, body.weights, body.agent_from_bone_rest)
    fit, held = (weight_refit.Poses.of(shape, recorded[at]) for at in (chosen, judged))
    skin = weight_refit.refit_weights(shape, fit)
    return skin, weight_refit.residual_m(vertices, skin, held)
