"""Read single frames at drawing size: color, depth, mask, flow, and their flow."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from pipeline.data.clips import Clip, Masks, usable_depth
from pipeline.data.flow import STRIDE_PX
from pipeline.geometry import cameras

AGENT, UNKNOWN = 255, 128
"""values of a mask"""


@dataclass(frozen=True)
class DrawnRecording:
    """One video's files."""

    id: str
    clip: Clip
    masks: Masks | None
    flow: tuple[Float[np.ndarray, "frame height width 2"], UInt8[np.ndarray, "frame height width"]] | None
    """forward flow of gap 1, color pixels at stride 4, and its confidence; memory-mapped"""


@dataclass(frozen=True)
class Target:
    """One frame at drawing size."""

    color: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    """metres; 0 = unknown"""
    agent: Bool[Tensor, "height width"]
    known: Bool[Tensor, "height width"]
    """the mask is not unknown"""
    intrinsics: Float[Tensor, "3 3"]
    flow_px: Float[Tensor, "row column 2"] | None
    """displacement in drawn pixels, on flow's own lattice"""
    flow_confidence: Float[Tensor, "row column"] | None


def drawn_size(recording: DrawnRecording, long_side_px: int) -> tuple[int, int]:
    """Return height and width of drawn pictures, in the shape of the recording's."""
    longest = max(recording.clip.color_size)
    height, width = (round(side * long_side_px / longest) for side in recording.clip.color_size)
    return height, width


def read(recording: DrawnRecording, frame: int, size: tuple[int, int], device: str) -> Target:
    """Read one frame and shrink it to (height, width)."""
    clip, small = recording.clip, size[::-1]
    color = cv2.resize(clip.color(frame), small, interpolation=cv2.INTER_AREA)
    depth = cv2.resize(usable_depth(clip, frame), small, interpolation=cv2.INTER_NEAREST_EXACT)
    mask = np.zeros(size, np.uint8)
    if recording.masks is not None:
        mask = cv2.resize(recording.masks[frame], small, interpolation=cv2.INTER_NEAREST_EXACT)
    flow = confidence = None
    if recording.flow is not None and frame < len(recording.flow[0]):
        scale = np.array([size[1] / clip.color_size[1], size[0] / clip.color_size[0]])
        forward, trust = (table[frame] for table in recording.flow)
        flow = torch.from_numpy((forward * scale).astype(np.float32)).to(device)
        confidence = torch.from_numpy(trust.astype(np.float32) / 255).to(device)
    intrinsics = cameras.scale_intrinsics(clip.intrinsics[frame], clip.color_size, size).astype(np.float32)
    measured = (
        color.astype(np.float32) / 255,
        depth.astype(np.float32),
        mask == AGENT,
        mask != UNKNOWN,
        intrinsics,
    )
    tensors = (torch.from_numpy(array).to(device) for array in measured)
    return Target(*tensors, flow_px=flow, flow_confidence=confidence)


def flow_lattice(
    rows: int, columns: int, color_size: tuple[int, int], size: tuple[int, int]
) -> tuple[Int[Tensor, "row 1"], Int[Tensor, "1 column"]]:
    """Return the drawn pixel (row, column) nearest to each cell centre of the flow; sizes are height and
    width.
    """
    row = (torch.arange(rows) * STRIDE_PX + STRIDE_PX / 2) * size[0] / color_size[0]
    column = (torch.arange(columns) * STRIDE_PX + STRIDE_PX / 2) * size[1] / color_size[1]
    return row.long().clamp_max(size[0] - 1)[:, None], column.long().clamp_max(size[1] - 1)[None]
