"""Videos with their motion, and their frames at rendering resolution: color, depth, mask, flow."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from pipeline.data import motion
from pipeline.data.clips import Clip, Masks, usable_depth
from pipeline.data.flow import STRIDE_PX, open_confidence, open_flow
from pipeline.data.motion import Motion
from pipeline.geometry import cameras

AGENT, UNKNOWN = 255, 128
"""values of a mask"""


@dataclass(frozen=True)
class DrawnVideo:
    """One video's files, and its motion on the frame axis of all videos."""

    id: str
    clip: Clip
    masks: Masks | None
    flow: tuple[Float[np.ndarray, "frame height width 2"], UInt8[np.ndarray, "frame height width"]] | None
    """forward flow of gap 1, color pixels at stride 4, and its confidence; memory-mapped"""
    motion: Motion
    first: int
    """index of its first frame"""
    appearance: int | None
    """index of its appearance; None: the turnaround, whose world is the agent"""

    def drawn_size(self, long_side_px: int) -> tuple[int, int]:
        """Return height and width of rendered pictures, in the recording's aspect ratio."""
        height, width = (
            round(side * long_side_px / max(self.clip.color_size)) for side in self.clip.color_size
        )
        return height, width

    def usable_frames(self) -> list[int]:
        """Return the frames whose camera is known, and for the turnaround also the agent's mask."""
        good = np.all(np.isfinite(self.motion.world_from_camera), axis=(1, 2))
        if self.appearance is None:
            assert self.masks is not None, "the turnaround has masks"
            good &= np.all(np.isfinite(self.motion.world_from_agent), axis=(1, 2)) & self.masks.visible
        return np.flatnonzero(good).tolist()


@dataclass(frozen=True)
class Target:
    """One frame at rendering resolution."""

    color: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    """meters; 0 = unknown"""
    agent: Bool[Tensor, "height width"]
    known: Bool[Tensor, "height width"]
    """the mask is not unknown"""
    intrinsics: Float[Tensor, "3 3"]
    flow_px: Float[Tensor, "row column 2"] | None
    """displacement in rendered pixels, on the flow's own lattice"""
    flow_confidence: Float[Tensor, "row column"] | None


def read_videos(
    reconstruction: Path, frames: Mapping[str, Path], masks: Mapping[str, Path], flow: Mapping[str, Path]
) -> list[DrawnVideo]:
    """Open all videos with their motion, sessions and templates, in id order on one frame axis."""
    videos, first, appearance = [], 0, 0
    for id in sorted(frames):
        session, template = reconstruction / id / "motion.npz", reconstruction / "templates" / f"{id}.npz"
        if not (session.exists() or template.exists()):
            continue
        loaded = motion.load(session if session.exists() else template)
        is_turnaround = not session.exists() and np.isfinite(loaded.world_from_agent).all((1, 2)).any()
        labels = Masks.open(masks[id]) if id in masks else None
        tables = (open_flow(flow[id], 1), open_confidence(flow[id], 1)) if id in flow else None
        own = None if is_turnaround else appearance
        videos.append(DrawnVideo(id, Clip.open(frames[id]), labels, tables, loaded, first, own))
        first += len(loaded.timestamp_s)
        appearance += not is_turnaround
    return videos


def read(video: DrawnVideo, frame: int, size: tuple[int, int], device: str) -> Target:
    """Read one frame, resized to (height, width)."""
    clip, small = video.clip, size[::-1]
    color = cv2.resize(clip.color(frame), small, interpolation=cv2.INTER_AREA)
    depth = cv2.resize(usable_depth(clip, frame), small, interpolation=cv2.INTER_NEAREST_EXACT)
    mask = np.zeros(size, np.uint8)
    if video.masks is not None:
        mask = cv2.resize(video.masks[frame], small, interpolation=cv2.INTER_NEAREST_EXACT)
    flow = confidence = None
    if video.flow is not None and frame < len(video.flow[0]):
        scale = np.array([size[1] / clip.color_size[1], size[0] / clip.color_size[0]])
        forward, trust = (table[frame] for table in video.flow)
        flow = torch.from_numpy((forward * scale).astype(np.float32)).to(device)
        confidence = torch.from_numpy(trust.astype(np.float32) / 255).to(device)
    intrinsics = cameras.scale_intrinsics(clip.intrinsics[frame], clip.color_size, size).astype(np.float32)
    color, depth = color.astype(np.float32) / 255, depth.astype(np.float32)
    measured = (color, depth, mask == AGENT, mask != UNKNOWN, intrinsics)
    tensors = (torch.from_numpy(array).to(device) for array in measured)
    return Target(*tensors, flow_px=flow, flow_confidence=confidence)


def flow_lattice(
    rows: int, columns: int, color_size: tuple[int, int], size: tuple[int, int]
) -> tuple[Int[Tensor, "row 1"], Int[Tensor, "1 column"]]:
    """Return the drawn pixel (row, column) nearest to each cell center of the flow; sizes: height, width."""
    row = (torch.arange(rows) * STRIDE_PX + STRIDE_PX / 2) * size[0] / color_size[0]
    column = (torch.arange(columns) * STRIDE_PX + STRIDE_PX / 2) * size[1] / color_size[1]
    return row.long().clamp_max(size[0] - 1)[:, None], column.long().clamp_max(size[1] - 1)[None]
