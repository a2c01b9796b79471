"""Turn a reconstruction and its behaviour models into the parts of a simulator: light, re-fitted, resampled."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.files.glb import Action, Skin
from pipeline.models import refit
from pipeline.space import rigid
from pipeline.space.meshes import Mesh
from stages.export_simulator import surfaces
from stages.export_simulator.actions import Motion, resample
from stages.export_simulator.contract import Setting
from stages.export_simulator.reading import Body, Gaussians

_JUDGED_POSES = 200


@dataclass(frozen=True)
class Made:
    """The parts of a simulator."""

    agent: Mesh
    skin: Skin
    residual_m: Float[np.ndarray, "frame vertex"]
    """distance of the four-weight linear blend from dual-quaternion blending, poses that were not fitted"""
    eight: refit.Influences
    """the same surface with eight weights, for players that can"""
    eight_residual_m: Float[np.ndarray, "frame vertex"]
    actions: list[Action]
    scene: Mesh
    splat_rows: bytes
    agent_splats: surfaces.SkinnedSplats
    setting: Setting
    motions: list[Motion]


def simulator(
    body: Body,
    scene: Mesh,
    gaussians: Gaussians,
    motions: list[Motion],
    limits: Any,
) -> Made:
    """Thin the surfaces, fit the weights, resample the motion; `limits` are the stage's settings."""
    agent, kept = surfaces.thin(body.mesh, limits.agent_faces)
    thinned = Body(agent, body.weights[kept], body.agent_from_bone_rest)
    four, eight = fitted(thinned, motions, limits.fitted_poses)
    names = tuple(f"bone_{bone:02d}" for bone in range(len(body.agent_from_bone_rest)))
    room, _ = surfaces.thin(scene, limits.scene_faces)
    inside = np.concatenate([motion.world_from_camera[:, :3, 3] for motion in motions]).mean(0)
    positions = np.concatenate([motion.world_from_agent[:, :3, 3] for motion in motions])
    return Made(
        agent=agent,
        skin=Skin(four.blend.joints, four.blend.weights, body.agent_from_bone_rest, names),
        residual_m=four.residual_m,
        eight=eight.blend,
        eight_residual_m=eight.residual_m,
        actions=[action(motion, limits.action_rate_hz) for motion in motions],
        scene=surfaces.facing(room, inside),
        splat_rows=surfaces.splat_rows(gaussians.scene, limits.scene_splats),
        agent_splats=surfaces.skinned_splats(gaussians.agent, gaussians.agent_weights, limits.agent_splats),
        setting=Setting(surfaces.floor_height_m(room, positions), surfaces.bounds(room)),
        motions=motions,
    )


@dataclass(frozen=True)
class Fitted:
    """Weights of a linear blend, and what is lost with them in poses that were not fitted."""

    blend: refit.Influences
    residual_m: Float[np.ndarray, "frame vertex"]


def fitted(body: Body, motions: list[Motion], poses: int) -> tuple[Fitted, Fitted]:
    """Fit four and eight weights a vertex to recorded poses that differ most."""
    recorded = np.concatenate([motion.agent_from_bone for motion in motions])
    chosen = refit.different_poses(recorded, poses)
    others = np.setdiff1d(np.arange(len(recorded)), chosen)
    judged = others[np.linspace(0, len(others) - 1, min(_JUDGED_POSES, len(others))).astype(int)] if len(others) else chosen
    vertices, rest = body.mesh.vertices.astype(np.float64), body.agent_from_bone_rest
    fit, held = (
        refit.Poses(recorded[at] @ rigid.inverse(rest), refit.blend_dual_quaternions(vertices, body.weights, recorded[at], rest))
        for at in (chosen, judged)
    )
    four, eight = refit.refit_weights(vertices, body.weights, fit)
    return Fitted(four, refit.residual_m(vertices, four, held)), Fitted(eight, refit.residual_m(vertices, eight, held))


def action(motion: Motion, rate_hz: float) -> Action:
    """Resample a recorded motion to an animation."""
    even = resample(motion, rate_hz)
    return Action(motion.name, even.timestamp_s, even.world_from_agent, even.agent_from_bone)
