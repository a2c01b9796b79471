"""The animal's motions on the body of another build."""

import numpy as np

from pipeline.data.glb import Action
from pipeline.fields import retargeting
from pipeline.fields.skinning import SkinnedShape
from stages.export.reading import Agent


def onto(agent: Agent, other: Agent) -> Agent:
    """Return the body of ``other`` with the motions of ``agent``."""
    source, target = _body(agent), _body(other)
    actions, residual = [], []
    for action in agent.actions:
        moved = retargeting.retarget(source, target, action.world_from_agent, action.agent_from_bone)
        actions.append(Action(action.name, action.time_s, moved.world_from_agent, moved.agent_from_bone))
        residual.append(moved.residual_m.ravel())
    residual_mm = 1000 * np.concatenate(residual)
    loss_mm = {
        "retargeting_mean": float(residual_mm.mean()),
        "retargeting_max": float(residual_mm.max()),
        "retargeting_shape_distance": 1000 * retargeting.shape_distance_m(source, target),
    }
    return Agent(other.mesh, other.skin, actions, agent.rate_hz, other.skinning_loss_mm, loss_mm)


def _body(agent: Agent) -> SkinnedShape:
    skin, rest = agent.skin, agent.skin.agent_from_bone_rest.astype(float)
    weights = np.zeros((len(skin.joints), len(rest)))
    np.add.at(weights, (np.arange(len(weights))[:, None], skin.joints.astype(int)), skin.weights)
    return SkinnedShape(agent.mesh.vertices.astype(float), weights, rest)
