"""How near short motions are to the true ones, and how physical they are (Sec. 4.3 of the paper)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.behavior.model import channels_from_bones
from pipeline.longterm.bodies import PoseSpace
from pipeline.longterm.clip_channels import Clips, decode_clip
from pipeline.longterm.config import MotionOptimizationConfig
from pipeline.longterm.contacts import motion_tensors
from pipeline.longterm.examples import MotionDataset
from pipeline.longterm.motion_optimization import optimize_motion
from pipeline.longterm.motion_synthesis import LongTerm
from pipeline.longterm.plausibility import PlausibilityMeter, seams
from pipeline.longterm.short_motions import STEPS, BodyMotion, concatenate_motions

METRICS = (
    "translation", "orientation", "pose", "mpjpe_mm", "mpvpe_mm",
    "end_v2v_share", "neighbour_v2v_mm", "neighbour_v2v_share", "seam_share", "seam_worst_mm",
    "non_collision", "contact", "penetration_mm", "slide_m_s", "planted", "min_slide_m_s",
)  # fmt: skip
"""translation, orientation, pose: L1 x 100 of root position (m), of its rotation's first two columns, of the
bones' channels (rad, m). MPJPE: origins of the bones. MPVPE: all vertices. Neighbour v2v, between one short
motion and the next, three ways. End v2v, the paper's words: distance of the first and last mesh from the
given ones. Neighbour v2v, the paper's figures, which for true motion are not nothing: distance from the given
ends to the meshes one frame further in. Seam: how much further the vertices move at the frame where two short
motions join than in the frames beside it, their mean and the worst of them. Share: of the body's length.
Slide: median speed of standing feet in that clip; planted: share of frames in which any foot stands; least
slide: speed of the foot that moves least."""
MEDIANS = ("slide_m_s", "min_slide_m_s")
"""Metrics of which the tables give the median over clips, not the mean."""


ENDS, NEXT_TO_ENDS = np.array([0, -1]), np.array([1, -2])


@dataclass(frozen=True)
class Reference:
    """Everything that motions of one clip are measured against."""

    truth: BodyMotion
    """as it was recorded"""
    judge: PlausibilityMeter

    @cached_property
    def mesh(self) -> Float[Tensor, "frame vertex 3"]:
        """The true body."""
        return self.judge.surface(*motion_tensors(self.truth))


def score(
    made: BodyMotion, reference: Reference, poses: PoseSpace, seam_m: Float[np.ndarray, "*seam vertex"]
) -> Float[np.ndarray, "metric"]:
    """Measure one motion; the feet that stand are those of the made motion itself."""
    body, truth = reference.judge.body, reference.truth
    stance = reference.judge.stance(made)
    worth = reference.judge.plausibility(made, stance)
    mesh = reference.judge.surface(*motion_tensors(made))
    apart = (mesh - reference.mesh).norm(dim=-1)
    next_to_ends = float((mesh[NEXT_TO_ENDS] - reference.mesh[ENDS]).norm(dim=-1).mean())
    turn = np.abs(made.world_from_agent - truth.world_from_agent)[:, :3, :2].mean()
    joints = [each.world_from_agent[:, None] @ each.agent_from_bone for each in (made, truth)]
    rest = poses.rest.double().numpy()
    pose = np.abs(
        channels_from_bones(made.agent_from_bone, rest) - channels_from_bones(truth.agent_from_bone, rest)
    ).mean()
    return np.array(
        [
            100 * np.abs(made.world_from_agent - truth.world_from_agent)[:, :3, 3].mean(),
            100 * turn,
            100 * pose,
            1000 * np.linalg.norm((joints[0] - joints[1])[..., :3, 3], axis=-1).mean(),
            1000 * float(apart.mean()),
            float(apart[ENDS].mean()) / body.length_m,
            1000 * next_to_ends,
            next_to_ends / body.length_m,
            seam_m.mean() / body.length_m,
            1000 * seam_m.max(),
            worth.non_collision,
            worth.contact,
            1000 * worth.penetration_m,
            worth.slide_m_s,
            stance.any(axis=1).mean(),
            worth.min_slide_m_s,
        ]
    )


def scores(
    channels: Float[Tensor, "clip frame channel"],
    clips: Clips,
    references: list[Reference],
    model: LongTerm,
    settings: MotionOptimizationConfig | None,
) -> Float[np.ndarray, "clip metric"]:
    """Measure the motions of one method on all clips, two of which always follow each other, and the seams
    between those.

    Where ``settings`` are given both are optimised as one motion, all but the given bodies at its ends and in
    its middle.
    """
    return scored(decoded(channels, clips, references, model), references, model, settings)


def decoded(
    channels: Float[Tensor, "clip frame channel"], clips: Clips, references: list[Reference], model: LongTerm
) -> list[BodyMotion]:
    """Turn the channels of a method into motions in the world; their ends are the true bodies."""
    return [
        decode_clip(each, frame, model.poses, reference.truth[ENDS].agent_from_bone)
        for each, frame, reference in zip(channels, clips.world_from_clip, references, strict=True)
    ]


def scored(
    motions: list[BodyMotion],
    references: list[Reference],
    model: LongTerm,
    settings: MotionOptimizationConfig | None = None,
) -> Float[np.ndarray, "clip metric"]:
    """Measure motions that follow each other two by two."""
    rows = []
    for start in range(0, len(motions), 2):
        judge = references[start].judge
        both = _joined(motions[start : start + 2], judge, model, settings)
        seam = seams(judge.body, both, STEPS, vertices=None)[0]
        halves = both[: STEPS + 1], both[STEPS:]
        rows += [
            score(half, known, model.poses, seam)
            for half, known in zip(halves, references[start : start + 2], strict=True)
        ]
    return np.array(rows).reshape(-1, len(METRICS))


def scored_whole(
    motions: list[BodyMotion],
    references: list[Reference],
    model: LongTerm,
    run: int,
    parts: int,
    settings: MotionOptimizationConfig | None = None,
) -> Float[np.ndarray, "run metric"]:
    """Measure the first ``parts`` of every ``run`` motions that follow each other as one motion."""
    rows = []
    for start in range(0, len(motions), run):
        some, judge = slice(start, start + parts), references[start].judge
        made = _joined(motions[some], judge, model, settings)
        truth = concatenate_motions([each.truth for each in references[some]])
        seam_m = seams(judge.body, made, STEPS, vertices=None)
        nowhere = np.full((1, 1), np.nan)
        rows.append(score(made, Reference(truth, judge), model.poses, seam_m if len(seam_m) else nowhere))
    return np.array(rows).reshape(-1, len(METRICS))


def _joined(
    motions: list[BodyMotion],
    judge: PlausibilityMeter,
    model: LongTerm,
    settings: MotionOptimizationConfig | None,
) -> BodyMotion:
    """Join motions; where ``settings`` are given all but the bodies at their ends is optimised as one."""
    joined = concatenate_motions(motions)
    if settings is None:
        return joined
    held = np.arange(len(joined)) % STEPS == 0
    return optimize_motion(joined, model.contact_body(judge.body), judge.scene, settings, held=held)


def references(
    parts: list[BodyMotion], scene: Int[np.ndarray, "clip"], dataset: MotionDataset, model: LongTerm
) -> list[Reference]:
    """Pair true short motions with what judges them, by the number of each one's scene."""
    judges = [PlausibilityMeter(dataset.body, model.contacts, each.distance) for each in dataset.scenes]
    return [Reference(part, judges[index]) for part, index in zip(parts, scene, strict=True)]
