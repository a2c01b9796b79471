"""Fuse the depth of all videos into the ground on which the scene's field learns.

Each video is fused into a volume of its own. `Ground` sums them up to the scene that all share, and keeps for each
video the blocks where it saw something else: things that were moved between the sessions.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float16

from pipeline import progress, threads
from pipeline.files import arrays
from pipeline.models.fused import CELLS, CHANNELS, NODES, NOWHERE, Fused
from pipeline.space.tsdf import Volume
from stages.reconstruct.assemble import Video, measured_box, scene_first
from stages.reconstruct.rays import AGENT, UNKNOWN, near_agent, trusted_depth

Box = tuple[tuple[float, ...], tuple[float, ...]]


@dataclass(frozen=True)
class Fusion:
    """How depth is fused."""

    voxel_m: float = 0.03
    """edge of a voxel"""
    truncation_m: float = 0.06
    """signed distances saturate here"""
    every: int = 5
    """one frame in so many"""
    ring_px: int = 10
    """left out around the agent's mask, colour pixels"""
    least_weight: float = 0.1
    """evidence below which a voxel counts as never seen: one frame from one metre is 1"""
    moved: tuple[float, float] = (0.3, 0.7)
    """a video differs from the others between these distances, in units of the truncation"""
    moved_voxels: int = 8
    """a block counts as changed from so many such voxels on"""


def ground(videos: Sequence[Video], margin_m: float, fusion: Fusion, scratch: Path | None = None, workers: int = 1) -> Fused:
    """Fuse the videos that have a scene, in the order of their codes, in the box of the scene's field; so many ``workers`` at once.

    Their volumes wait in unnamed files in ``scratch`` (None: where temporary files stand).
    """
    ground, shown = Ground(measured_box(videos, margin_m), fusion, scratch), [video for video in scene_first(videos) if video.has_scene]
    volumes = threads.ordered(lambda video: _fused(ground.empty(), video, fusion), shown, workers)
    for volume in progress.track(volumes, "fusing depth", total=len(shown)):
        ground.add(volume)
    return ground.finish()


def _fused(volume: Volume, video: Video, fusion: Fusion, least_confidence: float = 0.1) -> Volume:
    """Add what one video saw."""
    good = np.isfinite(video.world_from_camera).all((1, 2)) & (video.confidence >= least_confidence)
    for frame in np.flatnonzero(good)[:: fusion.every].tolist():
        _integrate(volume, video, frame, fusion.ring_px)
    return volume


def _integrate(volume: Volume, video: Video, frame: int, ring_px: int) -> None:
    """Add what one frame saw beside the agent."""
    clip, masks = video.source.clip, video.source.masks
    depth = trusted_depth(clip, frame)[0]
    if masks is not None:
        mask = masks[frame]
        hidden = (mask == UNKNOWN) | (near_agent(mask, ring_px) if masks.visible[frame] else mask == AGENT)
        depth[cv2.resize(hidden.astype(np.uint8), depth.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0] = 0
    volume.integrate(depth, clip.depth_intrinsics[frame], clip.color(frame), clip.intrinsics[frame], video.world_from_camera[frame])


@dataclass(frozen=True)
class _Kept:
    """One video's volume, packed, on disk."""

    distance: Float16[np.ndarray, "x y z"]
    weight: Float16[np.ndarray, "x y z"]
    color: np.ndarray
    colored: np.ndarray


class Ground:
    """Sums up volumes and sets the blocks of all videos."""

    def __init__(self, box: Box, fusion: Fusion, scratch: Path | None = None):
        self.scratch, self.fusion, self.low = scratch, fusion, np.asarray(box[0], float)
        self.size = np.ceil((np.asarray(box[1]) - self.low) / (fusion.voxel_m * CELLS)).astype(int)
        self.shared = self.empty()
        self.videos: list[_Kept] = []

    def empty(self) -> Volume:
        """Return a volume without measurements."""
        return Volume(self.low, tuple(self.size * CELLS + 1), self.fusion.voxel_m, self.fusion.truncation_m)

    def add(self, volume: Volume) -> None:
        """Take over one video."""
        shared = self.shared
        for value, weight in (("distance", "weight"), ("color", "color_weight")):
            mean, total, new, gain = (getattr(which, name) for which in (shared, volume) for name in (value, weight))
            total += gain
            share = gain / np.maximum(total, 1e-9)
            mean += (new - mean) * (share if mean.ndim == 3 else share[..., None])
        packed = volume.distance.astype(np.float16), np.minimum(volume.weight, 6e4).astype(np.float16)
        packed += (volume.color + 0.5).astype(np.uint8), volume.color_weight > 0
        self.videos.append(_Kept(*(arrays.Column(self.scratch).append(part).array() for part in packed)))

    def finish(self) -> Fused:
        """Return the blocks of the shared scene and of what each video saw otherwise."""
        shared, fusion = self.shared, self.fusion
        seen = shared.weight > fusion.least_weight
        shared.distance[~seen] = 1
        occupied = self._count(shared.distance < 0.99) > 0
        blocks = [np.stack([np.ones(NODES**3)] + [np.zeros(NODES**3)] * 4, axis=-1).reshape(1, NODES, NODES, NODES, CHANNELS)]
        table = np.full((len(self.videos) + 1, *self.size), NOWHERE, np.int32)
        table[:, occupied] = 1 + np.arange(occupied.sum())
        blocks += list(self._cut(occupied, shared.distance, shared.color / 255, shared.color_weight > 0))
        low, high = fusion.moved
        for row, video in enumerate(self.videos):
            seen = video.weight > fusion.least_weight
            other = np.clip((np.abs(video.distance - shared.distance) - low) / (high - low), 0, 1) * seen
            changed = self._count(other > 0.5) >= fusion.moved_voxels
            table[row][changed] = sum(len(part) for part in blocks) + np.arange(changed.sum())
            distance = shared.distance + other * (video.distance - shared.distance)
            takes = (other > 0.5) & video.colored
            color = np.where(takes[..., None], video.color, shared.color) / np.float32(255)
            blocks += list(self._cut(changed, distance, color, takes | (shared.color_weight > 0)))
        return Fused(
            torch.from_numpy(self.low), fusion.voxel_m, fusion.truncation_m,
            torch.from_numpy(table), torch.from_numpy(np.concatenate(blocks).astype(np.float16)),
        )  # fmt: skip

    def _count(self, marked: np.ndarray) -> np.ndarray:
        """Count marked cells in each block, by their lower nodes."""
        x, y, z = self.size
        return marked[:-1, :-1, :-1].reshape(x, CELLS, y, CELLS, z, CELLS).sum((1, 3, 5))

    def _cut(self, which: np.ndarray, distance: np.ndarray, color: np.ndarray, colored: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the chosen blocks, one array each."""
        for place in np.argwhere(which) * CELLS:
            part = tuple(slice(start, start + NODES) for start in place)
            known = colored[part][..., None].astype(np.float32)
            yield np.concatenate([distance[part][..., None], color[part] * known, known], axis=-1)[None].astype(np.float16)
