"""How near short motions are to the true ones, and how physical they are (Sec. 4.3 of the paper)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from pipeline.models.behavior import channels_from_bones
from pipeline.models.bodies import Body, PosedSurface, PoseSpace
from pipeline.models.clip_channels import Clips, decode_clip
from pipeline.models.contacts import tensors
from pipeline.models.longterm_examples import Lives
from pipeline.models.motion_optimization import Settings, optimise
from pipeline.models.motion_synthesis import LongTerm
from pipeline.models.plausibility import Judge
from pipeline.models.short_motions import Moving

METRICS = (
    "translation", "orientation", "pose", "mpjpe_mm", "mpvpe_mm", "neighbour_v2v_mm", "neighbour_v2v_share",
    "non_collision", "contact", "penetration_mm", "slide_m_s", "least_slide_m_s",
)  # fmt: skip
"""translation, orientation, pose: L1 x 100 of root position (m), of its rotation's first two columns, of the bones' channels
(rad, m). MPJPE: origins of the bones. MPVPE: all vertices. neighbour v2v: distance of the first and last mesh from the
given ones; its share of the body's length. Slide: median speed of
standing feet in that clip; least slide: of the foot that moves least."""


@dataclass(frozen=True)
class Reference:
    """Everything that motions of one clip are measured against."""

    truth: Moving
    """as it was recorded"""
    judge: Judge


def score(made: Moving, reference: Reference, poses: PoseSpace) -> Float[np.ndarray, "metric"]:
    """Measure one short motion; the feet that stand are those of the made motion itself."""
    body, truth = reference.judge.body, reference.truth
    worth = reference.judge.plausibility(made, reference.judge.stance(made))
    apart = _apart(made, truth, body)
    ends = float(apart[[0, -1]].mean())
    turn = np.abs(made.world_from_agent - truth.world_from_agent)[:, :3, :2].mean()
    joints = [each.world_from_agent[:, None] @ each.agent_from_bone for each in (made, truth)]
    rest = poses.rest.double().numpy()
    pose = np.abs(channels_from_bones(made.agent_from_bone, rest) - channels_from_bones(truth.agent_from_bone, rest)).mean()
    return np.array(
        [
            100 * np.abs(made.world_from_agent - truth.world_from_agent)[:, :3, 3].mean(),
            100 * turn,
            100 * pose,
            1000 * np.linalg.norm((joints[0] - joints[1])[..., :3, 3], axis=-1).mean(),
            1000 * float(apart.mean()),
            1000 * ends,
            ends / body.length_m,
            worth.non_collision,
            worth.contact,
            1000 * worth.penetration_m,
            worth.slide_m_s,
            worth.least_slide_m_s,
        ]
    )


def scores(
    channels: Float[Tensor, "clip frame channel"], clips: Clips, references: list[Reference], model: LongTerm, settings: Settings | None
) -> Float[np.ndarray, "clip metric"]:
    """Measure the motions of one method on all clips, after the optimisation where ``settings`` are given."""
    rows = []
    for made, frame, reference in zip(channels, clips.world_from_clip, references, strict=True):
        moving = decode_clip(made, frame, model.poses)
        if settings is not None:
            moving = optimise(moving, model.physique(reference.judge.body), reference.judge.scene, settings)
        rows.append(score(moving, reference, model.poses))
    return np.array(rows).reshape(-1, len(METRICS))


def references(parts: list[Moving], scene: np.ndarray, lives: Lives, model: LongTerm) -> list[Reference]:
    """Pair true short motions with what judges them."""
    judges = [Judge(lives.body, model.contacts, each.distance) for each in lives.scenes]
    return [Reference(part, judges[index]) for part, index in zip(parts, scene, strict=True)]


def _apart(first: Moving, second: Moving, body: Body) -> Float[Tensor, "frame vertex"]:
    surface = PosedSurface(body)
    return (surface(*tensors(first)) - surface(*tensors(second))).norm(dim=-1)
