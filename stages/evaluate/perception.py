"""Masks and flow against truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Shaped

from pipeline.data.clips import Masks
from pipeline.geometry import rigid
from pipeline.metrics.metrics import Metrics, mean, median
from stages.evaluate.reliability import reliability_metrics
from stages.evaluate.truth import RecordingTruth, TrueFlow

RIGHT_IOU = 0.75
"""IoU from which a mask is right, as in the report."""
SEEN_SHARE = 0.001
"""minimum share of the picture that is agent, in truth or ours, of counted frames"""


@dataclass(frozen=True)
class Overlaps:
    """Overlap per counted frame of one video."""

    iou: Float[np.ndarray, "frame"]
    resting: Bool[np.ndarray, "frame"]
    confidence: Float[np.ndarray, "frame"]
    """that the masks report"""
    unknown: Float[np.ndarray, "frame"]
    """share of the true agent's pixels that the mask calls unknown, which the overlap leaves out"""
    swapped: Bool[np.ndarray, "frame"] | None = None
    """whether the mask covers more of the other animals than of the agent; None where there are no others"""


def overlaps(masks: Masks, truth: RecordingTruth) -> Overlaps:
    """Compare every frame that shows the agent, in truth or in ours; unknown pixels do not count."""
    rows = []
    for frame in range(len(masks)):
        label = masks[frame]
        true = truth.masks[frame] if truth.masks.size else np.zeros(label.shape, bool)
        ours, counts = label == 255, label != 128
        if max(true.mean(), ours.mean()) < SEEN_SHARE:
            continue
        union = ((ours | true) & counts).sum()
        iou = (ours & true & counts).sum() / union if union else 0.0
        others = 0 if truth.others is None else (ours & truth.others[frame]).sum()
        unknown, swapped = mean(~counts[true]), others > (ours & true).sum()
        rows.append((iou, not truth.moving[frame], masks.confidence[frame], unknown, swapped))
    iou, resting, confidence, unknown, swapped = np.array(rows, float).reshape(-1, 5).T
    return Overlaps(iou, resting > 0, confidence, unknown, None if truth.others is None else swapped > 0)


def mask_metrics(sessions: Sequence[Overlaps], turnaround: Overlaps | None) -> Metrics:
    """Summarize overlaps of all sessions; the turnaround, which is easier, is separate."""
    metrics, none = Metrics(), [Overlaps(np.zeros(0), np.zeros(0, bool), np.zeros(0), np.zeros(0))]
    iou, resting, confidence, unknown = (
        np.concatenate([getattr(each, name) for each in sessions or none])
        for name in ("iou", "resting", "confidence", "unknown")
    )
    metrics.put("masks/iou_mean", mean(iou), "the animal is never visible")
    metrics.put("masks/unknown_share", mean(unknown[np.isfinite(unknown)]), "the animal is never visible")
    metrics.put("masks/iou_resting", mean(iou[resting]), "the animal never rests in view")
    swapped = [each.swapped for each in sessions if each.swapped is not None]
    if swapped:
        metrics.put("masks/identity_swaps", mean(np.concatenate(swapped)), "no animal is ever visible")
    metrics.add(reliability_metrics("masks", confidence, iou >= RIGHT_IOU))
    metrics.put("masks/iou_turnaround", mean(turnaround.iou) if turnaround else np.nan, "no turnaround")
    return metrics


PERSON_SEEN = 0.01
"""minimum share of the picture that shows a person, of counted frames"""


def people_metrics(
    sessions: Sequence[tuple[RecordingTruth, Mapping[str, Shaped[np.ndarray, "..."]]]],
) -> Metrics:
    """Compare `people.npz` with the true visitor: where people stand, over the floor and the phone, where
    they walk to, and how tall they are.

    The nearest of the tracks counts; `people/unseen` is the share of tracked frames that show nobody,
    `people/heading_known` the share of found frames in which a direction is given.
    """
    metrics, unseen, tracked_frames = Metrics(), 0, 0
    errors, turns, heights = [], [], []
    for truth, people in sessions:
        if truth.world_from_visitor is None or truth.visitor_seen is None:
            continue
        seen, tracks = truth.visitor_seen > PERSON_SEEN, people["feet_camera"].shape[1]
        feet_world = truth.world_from_visitor[:, :3, 3] * [1, 0, 1]
        camera_from_world = rigid.inverse(truth.world_from_camera)
        true = rigid.apply(camera_from_world, feet_world[:, None])
        off = np.linalg.norm(people["feet_camera"] - true, axis=-1)
        off = np.where(np.isfinite(off), off, np.inf)
        error = off.min(1, initial=np.inf)
        errors.append(error[seen])
        tracked_frames += int(np.isfinite(error).sum())
        unseen += int((np.isfinite(error) & (truth.visitor_seen == 0)).sum())
        if not tracks:
            continue
        nearest = off.argmin(1)
        ahead = people["ahead_camera"][np.arange(len(off)), nearest]
        true_ahead = camera_from_world[:, :3, :3] @ truth.world_from_visitor[:, :3, 2:3]
        cosine = np.clip((ahead[:, None] @ true_ahead)[:, 0, 0], -1, 1)
        turns.append(np.rad2deg(np.arccos(cosine))[seen & np.isfinite(error)])
        if truth.visitor_top_m is not None:
            of = np.bincount(nearest[seen & np.isfinite(error)], minlength=tracks) > 0
            heights.append(np.abs(people["height_m"][of] - np.median(truth.visitor_top_m)))
    if errors:
        error, turn = np.concatenate(errors), np.concatenate(turns or [np.zeros(0)])
        found, known = np.isfinite(error), np.isfinite(turn)
        height = np.concatenate(heights or [np.zeros(0)])
        metrics.put("people/found", mean(found), "nobody is ever in view")
        metrics.put("people/position_median_m", median(error[found]), "nobody was found")
        metrics.put("people/heading_known", mean(known), "nobody was found")
        metrics.put("people/heading_median_deg", median(turn[known]), "nobody walks")
        height = height[np.isfinite(height)]
        metrics.put("people/height_median_m", median(height), "no head is ever in the picture")
        share = unseen / tracked_frames if tracked_frames else np.nan
        metrics.put("people/unseen", share, "nobody was found")
    return metrics


ComparedFlow = tuple[Float[np.ndarray, "pair row column 2"], TrueFlow, Bool[np.ndarray, "frame height width"]]
"""Of a session: our flow of gap 1, the true flow, and the agent's true masks; color pixels"""


def flow_metrics(sessions: Sequence[ComparedFlow]) -> Metrics:
    """Return end-point errors, of ours and of predicting no motion at all.

    The agent's cells are those whose center it covers.
    """
    metrics, why = Metrics(), "no truth for neighboring frames"
    ours, zero, agent = [], [], []
    for found, true, masks in sessions:
        stride, (rows, columns) = masks.shape[1] // found.shape[1], found.shape[1:3]
        covered = masks[:, stride // 2 :: stride, stride // 2 :: stride][:, :rows, :columns]
        for first, flow in zip(true.first, true.flow, strict=True):
            known = np.isfinite(flow).all(-1)
            error = np.linalg.norm(found[first].astype(np.float32) - flow, axis=-1)
            ours.append(error[known])
            agent.append(error[known & covered[first]])
            zero.append(np.linalg.norm(flow, axis=-1)[known])
    for name, parts in (("epe_px_mean", ours), ("epe_px_agent_mean", agent), ("zero_flow_epe_px_mean", zero)):
        metrics.put(f"flow/{name}", mean(np.concatenate(parts) if parts else np.zeros(0)), why)
    return metrics
