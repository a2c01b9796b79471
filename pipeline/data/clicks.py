"""Clicked correspondences between frames of recordings and the walk-through: stored, back-projected, fitted.

The paper's protocol: about seven clicked pairs, both pixels back-projected by their depth, Procrustes. Frames
are named by recording and recorded number, pixels by shares of the upright picture, so that clicks outlive
builds.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pipeline.core.config import from_table
from pipeline.core.errors import InputError
from pipeline.data.clips import Clip, read_source_index
from pipeline.geometry import align, cameras, rigid

WANTED = 7
"""pairs per frame, as in the paper"""
MIN = 4
"""minimum pairs per frame for a fit"""
MAX_BYTES = 8 << 20
MAX_FRAMES = 1 << 31
"""upper bound of recorded frame numbers"""


@dataclass(frozen=True)
class ClickedPixel:
    """A pixel of one picture."""

    recording: str
    """file name of the recording"""
    source_index: int
    """number of the recorded frame"""
    pixel: tuple[float, float]
    """(x, y) as shares 0..1 of the upright picture's width and height"""


@dataclass(frozen=True)
class ClickedPair:
    """The same point in a recording's frame and in the walk-through."""

    seen: ClickedPixel
    reference: ClickedPixel


@dataclass(frozen=True)
class ClickedFile:
    """The content of a file of clicks."""

    pairs: tuple[ClickedPair, ...]


@dataclass(frozen=True)
class ClickedClip:
    """A recording's frames and their source numbers."""

    clip: Clip
    source_index: Int[np.ndarray, "frame"]

    @classmethod
    def open(cls, folder: Path) -> "ClickedClip":
        """Open a finished ``frames/<id>`` artifact."""
        return cls(Clip.open(folder), read_source_index(folder))

    def frame_of(self, click: ClickedPixel) -> int | None:
        """Return the extracted frame of a clicked pixel; None if its recorded frame was not extracted."""
        found = np.flatnonzero(self.source_index == click.source_index)
        return int(found[0]) if len(found) else None

    def lift(self, click: ClickedPixel) -> Float[np.ndarray, "3"] | None:
        """Back-project a click by the median depth around it: camera axes, meters; None without depth."""
        frame = self.frame_of(click)
        if frame is None:
            return None
        depth = self.clip.depth(frame)
        height, width = depth.shape
        x, y = click.pixel
        column, row = min(int(x * width), width - 1), min(int(y * height), height - 1)
        around = depth[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        if not (around > 0).any():
            return None
        pixel = np.array(click.pixel) * self.clip.color_size[::-1]
        return cameras.unproject(pixel, self.clip.intrinsics[frame]) * float(np.median(around[around > 0]))


@dataclass(frozen=True)
class ClickFit:
    """A camera pose from clicks."""

    world_from_camera: Float[np.ndarray, "4 4"]
    residual_m: Float[np.ndarray, "pair"]
    """distance per pair after the fit; NaN where depth is missing"""

    @property
    def typical_m(self) -> float:
        """Root mean square residual, meters."""
        return float(np.sqrt(np.nanmean(self.residual_m**2)))


def fit(
    pairs: Sequence[ClickedPair],
    seen: ClickedClip,
    reference: ClickedClip,
    world_from_reference: Float[np.ndarray, "frame 4 4"],
) -> ClickFit | None:
    """Fit the camera of the frame of all ``pairs``; None with fewer than four that have depth."""
    camera, world = np.full((len(pairs), 3), np.nan), np.full((len(pairs), 3), np.nan)
    for row, pair in enumerate(pairs):
        mine, theirs = seen.lift(pair.seen), reference.lift(pair.reference)
        frame = reference.frame_of(pair.reference)
        if mine is not None and theirs is not None and np.isfinite(world_from_reference[frame]).all():
            camera[row], world[row] = mine, rigid.apply(world_from_reference[frame], theirs[None])[0]
    known = np.isfinite(camera).all(1)
    if known.sum() < MIN:
        return None
    world_from_camera = align.kabsch(camera[known], world[known])
    return ClickFit(world_from_camera, np.linalg.norm(rigid.apply(world_from_camera, camera) - world, axis=1))


def by_frame(pairs: Sequence[ClickedPair], recording: str) -> dict[int, list[ClickedPair]]:
    """Group one recording's pairs by recorded frame."""
    found: dict[int, list[ClickedPair]] = {}
    for pair in pairs:
        if pair.seen.recording == recording:
            found.setdefault(pair.seen.source_index, []).append(pair)
    return dict(sorted(found.items()))


def read(path: Path) -> list[ClickedPair]:
    """Read a file of clicks; raises EVA-001 for anything else."""
    try:
        data = path.read_bytes()
        return parse(json.loads(data) if len(data) <= MAX_BYTES else None)
    except (OSError, ValueError, RecursionError, InputError) as error:
        remedy = "click again with `make annotate`, or remove the file"
        raise InputError("EVA-001", f"not a file of clicks: {error}", str(path), remedy) from error


def parse(table: Any) -> list[ClickedPair]:
    """Validate clicks from a file or a page; raises ValueError or InputError REC-001, REC-002."""
    if not isinstance(table, Mapping):
        raise ValueError("it holds no list of pairs")
    pairs = from_table(ClickedFile, table, where="clicks").pairs
    for spot in (spot for pair in pairs for spot in (pair.seen, pair.reference)):
        if not all(0 <= share <= 1 for share in spot.pixel):
            raise ValueError(f"a pixel lies outside of its picture: {spot.pixel}")
        if not 0 <= spot.source_index < MAX_FRAMES:
            raise ValueError("a source_index is no number of a recorded frame")
    return list(pairs)


def text(pairs: Sequence[ClickedPair]) -> str:
    """Return the file's content."""
    rows = [json.dumps(asdict(pair), sort_keys=True) for pair in pairs]
    return '{"pairs": [\n' + ",\n".join(rows) + "\n]}\n"
