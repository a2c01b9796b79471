"""Fuse the depth of all videos into the scene's fixed geometry.

Each video is fused into its own TSDF volume. `SceneFuser` averages them into the shared scene and keeps for
each video the blocks that differ from it: things that were moved between sessions.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float16

from pipeline.core import progress, threads
from pipeline.data import npz
from pipeline.fields.fused_depth import CELLS, CHANNELS, EMPTY_BLOCK, NODES, FusedGeometry
from pipeline.geometry.tsdf import Volume
from stages.reconstruct.assemble import Corner, RegisteredVideo, measured_box, scene_first
from stages.reconstruct.config import SceneFusion
from stages.reconstruct.rays import AGENT, UNKNOWN, near_agent, trusted_depth

Box = tuple[Corner, Corner]

FRAME_STEP = 5
"""one frame in so many is fused"""
TRUNCATION_VOXELS = 2.0
"""signed distances saturate at so many voxels"""
MASK_MARGIN_PX = 10
"""margin around the agent's mask that is ignored, color pixels"""
MIN_WEIGHT = 0.1
"""TSDF weight below which a voxel is unseen: one frame from one meter is 1"""
MAX_WEIGHT = 6e4
"""TSDF weights are clamped here, just below the largest half float"""
CHANGE_RANGE = (0.3, 0.7)
"""differences, in units of the truncation, between which the shared scene is blended into the video's own"""
MIN_CHANGED_VOXELS = 8
"""changed voxels (beyond the middle of that range) from which a block is kept per video"""
MIN_SURFACE = 0.99
"""blocks with a signed distance below this, in units of the truncation, are stored"""


def fuse_depth(
    videos: Sequence[RegisteredVideo], fusion: SceneFusion, scratch: Path | None = None, workers: int = 1
) -> FusedGeometry:
    """Fuse the videos that have a scene, in the order of their codes, in the box of the scene's field.

    ``workers``: videos fused in parallel. Volumes are kept in unnamed files in ``scratch`` (None: the
    directory of temporary files).
    """
    fuser = SceneFuser(measured_box(videos), fusion.voxel_m, scratch)
    with_scene = [video for video in scene_first(videos) if video.has_scene]
    volumes = threads.ordered(lambda video: _fused(fuser.empty(), video), with_scene, workers)
    for volume in progress.track(volumes, "fusing depth", total=len(with_scene)):
        fuser.add(volume)
    return fuser.finish()


def _fused(volume: Volume, video: RegisteredVideo) -> Volume:
    """Integrate the depth of one video's frames, without the agent."""
    clip, masks = video.clip, video.masks
    assert clip is not None, f"{video.id} was read without its pictures"
    for frame in np.flatnonzero(video.certain_cameras)[::FRAME_STEP].tolist():
        depth = trusted_depth(clip, frame)[0]
        if masks is not None:
            mask = masks[frame]
            agent = near_agent(mask, MASK_MARGIN_PX) if masks.visible[frame] else mask == AGENT
            ignored = ((mask == UNKNOWN) | agent).astype(np.uint8)
            depth[cv2.resize(ignored, depth.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0] = 0
        lenses = clip.depth_intrinsics[frame], clip.intrinsics[frame]
        volume.integrate(depth, lenses[0], clip.color(frame), lenses[1], video.world_from_camera[frame])
    return volume


@dataclass(frozen=True)
class _PackedVolume:
    """One video's volume, packed, on disk."""

    distance: Float16[np.ndarray, "x y z"]
    weight: Float16[np.ndarray, "x y z"]
    color: np.ndarray
    colored: np.ndarray


class SceneFuser:
    """Averages the volumes of all videos, then splits them into sparse blocks."""

    def __init__(self, box: Box, voxel_m: float, scratch: Path | None = None):
        """Prepare for volumes in ``box`` (lower and upper corner, meters)."""
        self.scratch, self.voxel_m, self.low = scratch, voxel_m, np.asarray(box[0], float)
        self.size = np.ceil((np.asarray(box[1]) - self.low) / (voxel_m * CELLS)).astype(int)
        self.shared = self.empty()
        self.videos: list[_PackedVolume] = []

    def empty(self) -> Volume:
        """Return a volume without measurements."""
        nodes = tuple(self.size * CELLS + 1)
        return Volume(self.low, nodes, self.voxel_m, TRUNCATION_VOXELS * self.voxel_m)

    def add(self, volume: Volume) -> None:
        """Add the volume of one video."""
        shared = self.shared
        for value, weight in (("distance", "weight"), ("color", "color_weight")):
            mean, total = getattr(shared, value), getattr(shared, weight)
            new, gain = getattr(volume, value), getattr(volume, weight)
            total += gain
            share = gain / np.maximum(total, 1e-9)
            mean += (new - mean) * (share if mean.ndim == 3 else share[..., None])
        packed = volume.distance.astype(np.float16), np.minimum(volume.weight, MAX_WEIGHT).astype(np.float16)
        packed += (volume.color + 0.5).astype(np.uint8), volume.color_weight > 0
        self.videos.append(_PackedVolume(*(npz.Column(self.scratch).append(part).array() for part in packed)))

    def finish(self) -> FusedGeometry:
        """Return the blocks of the shared scene, and of each video where it differs."""
        shared = self.shared
        seen = shared.weight > MIN_WEIGHT
        shared.distance[~seen] = 1
        occupied = self._count(shared.distance < MIN_SURFACE) > 0
        empty = np.zeros((1, NODES, NODES, NODES, CHANNELS))
        empty[..., 0] = 1
        blocks = [empty]
        table = np.full((len(self.videos) + 1, *self.size), EMPTY_BLOCK, np.int32)
        table[:, occupied] = 1 + np.arange(occupied.sum())
        blocks += list(self._blocks(occupied, shared.distance, shared.color / 255, shared.color_weight > 0))
        low, high = CHANGE_RANGE
        for row, video in enumerate(self.videos):
            seen = video.weight > MIN_WEIGHT
            change = np.clip((np.abs(video.distance - shared.distance) - low) / (high - low), 0, 1) * seen
            changed = self._count(change > 0.5) >= MIN_CHANGED_VOXELS
            table[row][changed] = sum(len(part) for part in blocks) + np.arange(changed.sum())
            distance = shared.distance + change * (video.distance - shared.distance)
            own_color = (change > 0.5) & video.colored
            color = np.where(own_color[..., None], video.color, shared.color) / np.float32(255)
            blocks += list(self._blocks(changed, distance, color, own_color | (shared.color_weight > 0)))
        stacked = np.concatenate(blocks).astype(np.float16)
        low, rows, stacked = (torch.from_numpy(array) for array in (self.low, table, stacked))
        return FusedGeometry(low, self.voxel_m, TRUNCATION_VOXELS * self.voxel_m, rows, stacked)

    def _count(self, marked: np.ndarray) -> np.ndarray:
        """Count marked cells in each block, by their lower nodes."""
        x, y, z = self.size
        return marked[:-1, :-1, :-1].reshape(x, CELLS, y, CELLS, z, CELLS).sum((1, 3, 5))

    def _blocks(self, which, distance, color, colored) -> Iterator[np.ndarray]:
        """Yield the chosen blocks, one array each."""
        for place in np.argwhere(which) * CELLS:
            part = tuple(slice(start, start + NODES) for start in place)
            known = colored[part][..., None].astype(np.float32)
            block = np.concatenate([distance[part][..., None], color[part] * known, known], axis=-1)
            yield block[None].astype(np.float16)
