"""Turn a reconstruction and its behaviour models into the parts of a simulator: light, re-fitted, resampled."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.files.glb import Action, Skin
from pipeline.space import rigid
from pipeline.space.meshes import Mesh
from stages.export_simulator import refit, surfaces
from stages.export_simulator.actions import Motion, resample
from stages.export_simulator.contract import Setting
from stages.export_simulator.reading import Body


@dataclass(frozen=True)
class Made:
    """The parts of a simulator."""

    agent: Mesh
    skin: Skin
    residual_m: Float[np.ndarray, "frame vertex"]
    """distance of the four-weight linear blend from dual-quaternion blending, fitted poses"""
    actions: list[Action]
    scene: Mesh
    splat_rows: bytes
    setting: Setting
    motions: list[Motion]


def simulator(
    body: Body,
    scene: Mesh,
    gaussians: Float[np.ndarray, "point 62"],
    motions: list[Motion],
    limits: Any,
    rng: np.random.Generator,
) -> Made:
    """Thin the surfaces, fit the weights, resample the motion; `limits` are the stage's settings."""
    agent, kept = surfaces.thin(body.mesh, limits.agent_faces)
    thinned = Body(agent, body.weights[kept], body.agent_from_bone_rest)
    skin, residual_m = fitted_skin(thinned, motions, limits.fitted_poses, rng)
    room, _ = surfaces.thin(scene, limits.scene_faces)
    inside = np.concatenate([motion.world_from_camera[:, :3, 3] for motion in motions]).mean(0)
    positions = np.concatenate([motion.world_from_agent[:, :3, 3] for motion in motions])
    return Made(
        agent=agent,
        skin=skin,
        residual_m=residual_m,
        actions=[action(motion, limits.action_rate_hz) for motion in motions],
        scene=surfaces.facing(room, inside),
        splat_rows=surfaces.splat_rows(gaussians, limits.scene_splats),
        setting=Setting(surfaces.floor_height_m(room, positions), surfaces.bounds(room)),
        motions=motions,
    )


def fitted_skin(body: Body, motions: list[Motion], poses: int, rng: np.random.Generator) -> tuple[Skin, Float[np.ndarray, "frame vertex"]]:
    """Fit four weights a vertex to recorded poses drawn at random; also return what is lost there, metres."""
    recorded = np.concatenate([motion.agent_from_bone for motion in motions])
    chosen = np.sort(rng.choice(len(recorded), size=min(poses, len(recorded)), replace=False))
    agent_from_bone = recorded[chosen]
    vertices = body.mesh.vertices.astype(np.float64)
    posed = refit.blend_dual_quaternions(vertices, body.weights, agent_from_bone, body.agent_from_bone_rest)
    posed_from_rest = agent_from_bone @ rigid.inverse(body.agent_from_bone_rest)
    joints, weights = refit.refit_weights(vertices, body.weights, posed_from_rest, posed)
    names = tuple(f"bone_{bone:02d}" for bone in range(len(body.agent_from_bone_rest)))
    residual_m = refit.residual_m(vertices, joints, weights, posed_from_rest, posed)
    return Skin(joints, weights, body.agent_from_bone_rest, names), residual_m


def action(motion: Motion, rate_hz: float) -> Action:
    """Resample a recorded motion to an animation."""
    even = resample(motion, rate_hz)
    return Action(motion.name, even.timestamp_s, even.world_from_agent, even.agent_from_bone)
