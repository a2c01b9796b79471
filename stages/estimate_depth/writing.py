"""Write frames whose depth was estimated as the ``frames/<id>`` artifact, and check their quality."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int

from pipeline.data import images, plots, qa
from pipeline.data.clips import FRAMES, MAPPED, Pictures
from pipeline.geometry import cameras, subsampling
from pipeline.recordings.extraction import quality_of
from stages.estimate_depth.depth import FrameDepth
from stages.estimate_depth.lens import Lens
from stages.estimate_depth.tracking import Tracked

SHOWN = 10
"""Frames on the contact sheet."""


@dataclass(frozen=True)
class Estimated:
    """Estimated cameras and depth of a recording."""

    placed: Int[np.ndarray, "chosen"]
    """Indices of the frames written."""
    tracked: Tracked
    lens: Lens
    depths: Sequence[FrameDepth]
    """Of the frames written."""


def write(folder: Path, pictures: Pictures, estimated: Estimated, jpeg_quality: int) -> None:
    """Write pictures, depth, confidence and the table of the chosen frames."""
    for name in ("color", "depth", "confidence", "foreground"):
        (folder / name).mkdir()
    chosen, lens = estimated.placed, estimated.lens
    for number, (frame, found) in enumerate(zip(chosen.tolist(), estimated.depths, strict=True)):
        color = folder / "color" / f"{number:06d}.jpg"
        if lens.is_distorted:
            images.write_color(color, lens.undistorted(pictures.color(frame)), jpeg_quality)
        else:
            color.write_bytes(pictures.file(frame).read_bytes())
        images.write_depth(folder / "depth" / f"{number:06d}.exr", found.depth)
        images.write_gray(folder / "confidence" / f"{number:06d}.png", found.confidence)
        images.write_gray(folder / "foreground" / f"{number:06d}.png", found.foreground)
    valid = np.array([(each.depth > 0).mean() for each in estimated.depths])
    pictured = quality_of(pictures.sharpness, pictures.brightness, np.ones(len(pictures.sharpness)))
    small = cameras.scale_intrinsics(lens.intrinsics, lens.size, estimated.depths[0].depth.shape)
    FRAMES.save(
        folder / "frames.npz",
        timestamp_s=pictures.timestamp_s[chosen],
        intrinsics=np.repeat(lens.intrinsics[None], len(chosen), axis=0),
        depth_intrinsics=np.repeat(small[None], len(chosen), axis=0),
        odometry_from_camera=estimated.tracked.world_from_camera[chosen],
        gravity_known=np.array(True),
        scale=np.array(MAPPED),
        source_index=pictures.source_index[chosen],
        quarter_turns=np.array(pictures.quarter_turns),
        sharpness=pictures.sharpness[chosen],
        brightness=pictures.brightness[chosen],
        depth_valid=valid.astype(np.float32),
        quality=(pictured[chosen] * valid).astype(np.float32),
    )


def report_quality(folder: Path, pictures: Pictures, estimated: Estimated) -> None:
    """Write the quality page: shares of measured and inferred depth."""
    chosen, depths = estimated.placed, estimated.depths
    placed = 100 * len(chosen) / len(pictures)
    alone = 100 * float(estimated.tracked.by_landmarks[chosen].mean())
    known = 100 * float(np.mean([(each.depth > 0).mean() for each in depths]))
    animal = 100 * float(np.mean([each.depth[each.foreground > 0].any() for each in depths]))
    checks = [
        qa.Check("frames placed in the map", placed, "%", warn=80.0, better="higher"),
        qa.Check("placed by landmarks, the others tracked", alone, "%", warn=30.0, better="higher"),
        qa.Check("focal length, calibrated", estimated.lens.focal_px, "px"),
        qa.Check("known depth", known, "%", warn=50.0, better="higher"),
        qa.Check("frames with depth of the animal", animal, "%"),
    ]
    shown, size = subsampling.evenly(len(chosen), SHOWN), depths[0].depth.shape
    colors = [plots.resized(pictures.color(int(chosen[number])), size) for number in shown]
    sheet = plots.grid([*colors, *(plots.depth_colors(depths[number].depth) for number in shown)], len(shown))
    qa.write(
        folder,
        good="depth follows the pictures' edges; the animal stands out of it on its feet",
        bad="edges of furniture beside those of the picture, blotches where nothing moves, no animal",
        checks=checks,
        pictures=[qa.Picture("depth", sheet, "frames, and their depth: black is unknown")],
    )
