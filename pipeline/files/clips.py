"""Recordings as the stages see them: `Clip` over ``frames/<id>/`` and `Masks` over ``masks/<id>/``.

Both open in milliseconds and read pictures one at a time, so that a clip of any length fits in memory.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.files import arrays, images


@dataclass(frozen=True)
class Clip:
    """One recording at 10 Hz: upright colour, depth in metres, confidence, intrinsics, the phone's odometry."""

    folder: Path
    timestamp_s: Float[np.ndarray, "frame"]
    intrinsics: Float[np.ndarray, "frame 3 3"]
    depth_intrinsics: Float[np.ndarray, "frame 3 3"]
    odometry_from_camera: Float[np.ndarray, "frame 4 4"] | None
    gravity_known: bool
    quality: Float[np.ndarray, "frame"]
    color_size: tuple[int, int]
    """(height, width) in pixels"""
    depth_size: tuple[int, int]
    """(height, width) in pixels"""
    scale: str = "measured"
    """what makes its lengths metres: its own depth, the id of another recording whose depth does, or nothing: `relative`"""

    @classmethod
    def open(cls, folder: Path) -> "Clip":
        """Open a finished ``frames/<id>`` artifact."""
        table = arrays.load(folder / "frames.npz")
        return cls(
            folder=folder,
            timestamp_s=table["timestamp_s"],
            intrinsics=table["intrinsics"],
            depth_intrinsics=table["depth_intrinsics"],
            odometry_from_camera=table.get("odometry_from_camera"),
            gravity_known=bool(table["gravity_known"]),
            quality=table["quality"],
            color_size=images.read_color(folder / "color" / "000000.jpg").shape[:2],
            depth_size=images.read_depth(folder / "depth" / "000000.exr").shape,
            scale=str(table.get("scale", "measured")),
        )

    def __len__(self) -> int:
        return len(self.timestamp_s)

    def color(self, frame: int) -> UInt8[np.ndarray, "height width 3"]:
        """Read one frame's RGB."""
        return images.read_color(self.folder / "color" / f"{frame:06d}.jpg")

    def depth(self, frame: int) -> Float[np.ndarray, "height width"]:
        """Read one frame's depth in metres, 0 = unknown, at the sensor's resolution."""
        return images.read_depth(self.folder / "depth" / f"{frame:06d}.exr")

    def confidence(self, frame: int) -> UInt8[np.ndarray, "height width"]:
        """Read one frame's depth confidence: 0 low, 1 medium, 2 high."""
        return images.read_gray(self.folder / "confidence" / f"{frame:06d}.png")


@dataclass(frozen=True)
class Masks:
    """The agent's masks of one recording, at colour resolution: 255 agent, 0 not, 128 unknown."""

    folder: Path
    visible: np.ndarray
    """[frame] bool: the agent was found"""
    confidence: Float[np.ndarray, "frame"]

    @classmethod
    def open(cls, folder: Path) -> "Masks":
        """Open a finished ``masks/<id>`` artifact."""
        table = arrays.load(folder / "masks.npz")
        return cls(folder, table["visible"], table["confidence"])

    def __len__(self) -> int:
        return len(self.visible)

    def __getitem__(self, frame: int) -> UInt8[np.ndarray, "height width"]:
        if not 0 <= frame < len(self):
            raise IndexError(frame)
        return images.read_gray(self.folder / f"{frame:06d}.png")
