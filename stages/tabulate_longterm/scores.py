"""Metrics of motions: errors against the truth, and physical plausibility (Sec. 4.3 of the paper)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.behavior.model import channels_from_bones
from pipeline.longterm.bodies import PoseSpace
from pipeline.longterm.clip_channels import Clips, decode_clip
from pipeline.longterm.config import MotionOptimizationConfig
from pipeline.longterm.examples import MotionDataset
from pipeline.longterm.motion_optimization import optimize_motion
from pipeline.longterm.motion_synthesis import LongTerm
from pipeline.longterm.plausibility import PlausibilityMeter, seams
from pipeline.longterm.short_motions import STEPS, BodyMotion, concatenate_motions

METRICS = (
    "translation", "orientation", "pose", "mpjpe_mm", "mpvpe_mm",
    "end_v2v_share", "neighbor_v2v_mm", "neighbor_v2v_share", "seam_share", "seam_worst_mm",
    "non_collision", "contact", "penetration_mm", "slide_m_s", "planted", "min_slide_m_s",
)  # fmt: skip
"""translation, orientation, pose: L1 x 100 of root position (m), 6D root rotation, and the bones' channels
(rad, m). MPJPE: origins of the bones. MPVPE: all vertices. The paper's neighbor v2v in three readings. End
v2v, as the text defines it: distance of the first and last mesh from the given ones. Neighbor v2v, as its
values suggest, since they are not zero for true motion: distance of the given ends from the meshes one frame
further in. Seam: how much longer the vertices' steps are at the frame where two clips join than beside it,
mean and maximum. Share: relative to body length. Slide: median speed of feet in stance; planted: share of
frames with any foot in stance; min slide: median speed of the slowest foot."""
MEDIANS = ("slide_m_s", "min_slide_m_s")
"""Metrics whose median over clips is tabulated instead of the mean."""
ENDS, NEXT_TO_ENDS = np.array([0, -1]), np.array([1, -2])


@dataclass(frozen=True)
class Reference:
    """The truth and the plausibility meter of one clip."""

    truth: BodyMotion
    """the recorded motion"""
    meter: PlausibilityMeter

    @cached_property
    def mesh(self) -> Float[Tensor, "frame vertex 3"]:
        """The true vertices."""
        return self.meter.surface(*self.truth.tensors())


def score(
    made: BodyMotion, reference: Reference, poses: PoseSpace, seam_m: Float[np.ndarray, "*seam vertex"]
) -> Float[np.ndarray, "metric"]:
    """Return the metrics of one motion; stance is detected on the motion itself."""
    body, truth = reference.meter.body, reference.truth
    stance = reference.meter.stance(made)
    metrics = reference.meter.plausibility(made, stance)
    mesh = reference.meter.surface(*made.tensors())
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
            metrics.non_collision,
            metrics.contact,
            1000 * metrics.penetration_m,
            metrics.slide_m_s,
            stance.any(axis=1).mean(),
            metrics.min_slide_m_s,
        ]
    )


def decode_clips(
    channels: Float[Tensor, "clip frame channel"], clips: Clips, references: list[Reference], model: LongTerm
) -> list[BodyMotion]:
    """Decode the channels of a method to motions in the world; their ends are the true bodies."""
    return [
        decode_clip(each, frame, model.poses, reference.truth[ENDS].agent_from_bone)
        for each, frame, reference in zip(channels, clips.world_from_clip, references, strict=True)
    ]


def score_pairs(
    motions: list[BodyMotion],
    references: list[Reference],
    model: LongTerm,
    settings: MotionOptimizationConfig | None = None,
) -> Float[np.ndarray, "clip metric"]:
    """Return the metrics of motions in consecutive pairs, with the seam within each pair.

    With ``settings`` each pair is optimized as one motion, except the given bodies at its ends and middle.
    """
    rows = []
    for start in range(0, len(motions), 2):
        meter = references[start].meter
        both = _joined(motions[start : start + 2], meter, model, settings)
        seam = seams(meter.body, both, STEPS, vertices=None)[0]
        halves = both[: STEPS + 1], both[STEPS:]
        rows += [
            score(half, known, model.poses, seam)
            for half, known in zip(halves, references[start : start + 2], strict=True)
        ]
    return np.array(rows).reshape(-1, len(METRICS))


def score_runs(
    motions: list[BodyMotion],
    references: list[Reference],
    model: LongTerm,
    run: int,
    parts: int,
    settings: MotionOptimizationConfig | None = None,
) -> Float[np.ndarray, "run metric"]:
    """Return the metrics of the first ``parts`` of every ``run`` consecutive motions, as one motion."""
    rows = []
    for start in range(0, len(motions), run):
        some, meter = slice(start, start + parts), references[start].meter
        made = _joined(motions[some], meter, model, settings)
        truth = concatenate_motions([each.truth for each in references[some]])
        seam_m = seams(meter.body, made, STEPS, vertices=None)
        nowhere = np.full((1, 1), np.nan)
        rows.append(score(made, Reference(truth, meter), model.poses, seam_m if len(seam_m) else nowhere))
    return np.array(rows).reshape(-1, len(METRICS))


def _joined(
    motions: list[BodyMotion],
    meter: PlausibilityMeter,
    model: LongTerm,
    settings: MotionOptimizationConfig | None,
) -> BodyMotion:
    joined = concatenate_motions(motions)
    if settings is None:
        return joined
    held = np.arange(len(joined)) % STEPS == 0
    return optimize_motion(joined, meter, model.poses, settings, held=held)


def references(
    parts: list[BodyMotion], scene: Int[np.ndarray, "clip"], dataset: MotionDataset, model: LongTerm
) -> list[Reference]:
    """Pair true motions with the plausibility meters of their scenes, given by index."""
    meters = [PlausibilityMeter(dataset.body, model.contacts, each.distance) for each in dataset.scenes]
    return [Reference(part, meters[index]) for part, index in zip(parts, scene, strict=True)]
