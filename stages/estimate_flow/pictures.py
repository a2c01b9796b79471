"""The quality page of the flow: how often both directions agree, and flow wheels of a few frames."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.data import plots, qa
from pipeline.data.flow import STRIDE_PX, open_confidence, open_flow
from pipeline.geometry import subsampling

SHOWN_FRAMES = 6
MIN_AGREEMENT = {1: 0.6, 2: 0.5, 4: 0.35, 8: 0.2}
"""share of vectors that should agree, by the gap"""
CERTAIN = 128
"""stored confidence (of 255) that counts as agreement"""


@dataclass(frozen=True)
class Review:
    """What one gap looks like."""

    gap: int
    agreement: float
    """share of vectors on which both directions agree"""
    strip: UInt8[np.ndarray, "height width 3"] | None


def review(folder: Path, gap: int, color: Callable[[int], UInt8[np.ndarray, "height width 3"]]) -> Review:
    """Summarize the forward flow of one gap as it was written; ``color(i)`` gives frame i."""
    flows, confidences = open_flow(folder, gap), open_confidence(folder, gap)
    if len(flows) == 0:
        return Review(gap, float("nan"), None)
    agreement = [(confidence >= CERTAIN).mean() for confidence in confidences]
    shown = subsampling.evenly(len(flows), SHOWN_FRAMES)
    columns = [_column(color(int(i)), flows[i], confidences[i]) for i in shown]
    strip = np.concatenate([*columns, _key(len(columns[0]))], axis=1)
    return Review(gap, float(np.mean(agreement)), strip)


def report_quality(folder: Path, reviews: Sequence[Review]) -> None:
    """Write the stage's own judgment."""
    checks = []
    for each in reviews:
        name, least = f"both directions agree, {each.gap} apart", 100 * MIN_AGREEMENT[each.gap]
        checks.append(qa.Check(name, 100 * each.agreement, "%", warn=least, better="higher"))
    caption = "frames, flow to {} later (hue = direction, as the disc shows), dark where uncertain"
    shown = [(each.gap, each.strip) for each in reviews if each.strip is not None]
    pictures = [qa.Picture(f"gap_{gap}", strip, caption.format(gap)) for gap, strip in shown]
    qa.write(
        folder,
        good="one smooth color for the moving camera, another inside the animal, dark only at edges",
        bad="speckles of all colors, large dark areas in the middle",
        checks=checks,
        pictures=pictures,
    )


def flow_wheel(
    flow: Float[np.ndarray, "height width 2"], full_px: float
) -> UInt8[np.ndarray, "height width 3"]:
    """Color vectors: hue is direction, brightness is length up to ``full_px``."""
    flow = flow.astype(np.float32)
    hue = np.degrees(np.arctan2(flow[..., 1], flow[..., 0])) % 360 / 2
    value = np.clip(np.linalg.norm(flow, axis=-1) / full_px, 0, 1) * 255
    hsv = np.stack([hue, np.full_like(hue, 220), value], axis=-1).astype(np.uint8)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)


def _key(height: int, edge: int = 96) -> UInt8[np.ndarray, "height width 3"]:
    """Draw what colors mean: a disc with, at each place, the color of motion towards it, bright if fast."""
    key = np.full((height, edge, 3), 255, np.uint8)
    along = np.arange(edge) - (edge - 1) / 2
    towards = np.stack(np.meshgrid(along, along), axis=-1)
    radius = 0.42 * edge
    inside = np.linalg.norm(towards, axis=-1) <= radius
    top = max(height - edge, 0)
    part = key[top : top + edge]
    part[inside[: len(part)]] = flow_wheel(towards, radius)[: len(part)][inside[: len(part)]]
    return key


def _column(
    color: np.ndarray, flow: np.ndarray, confidence: np.ndarray
) -> UInt8[np.ndarray, "height width 3"]:
    full_px = max(float(np.percentile(np.linalg.norm(flow.astype(np.float32), axis=-1), 95)), 1.0)
    wheel = flow_wheel(flow, full_px) * (0.25 + 0.75 * confidence[..., None] / 255)
    crop = color[: flow.shape[0] * STRIDE_PX, : flow.shape[1] * STRIDE_PX]
    size = (2 * flow.shape[0], 2 * flow.shape[1])
    return plots.grid([plots.resized(crop, size), plots.resized(wheel.astype(np.uint8), size)], 1)
