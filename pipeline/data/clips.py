"""Recordings as the stages see them: `Clip` over ``frames/<id>/`` and `Masks` over ``masks/<id>/``.

Both open in milliseconds and read pictures one at a time, so that a clip of any length fits in memory.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.data import images
from pipeline.data.schema import FileSchema
from pipeline.geometry import cameras

FRAMES = FileSchema.of(
    "frames/frames.npz",
    "timestamp_s [frame] f8",
    "intrinsics [frame 3 3] f8",
    "depth_intrinsics [frame 3 3] f8",
    "odometry_from_camera [frame 4 4] f8?",
    "gravity_known [] bool",
    "scale [] U?",
    "source_index [frame] i8",
    "quarter_turns [] i8",
    "sharpness [frame] f4",
    "brightness [frame] f4",
    "depth_valid [frame] f4",
    "quality [frame] f4",
)
PICTURES = FileSchema.of(
    "pictures/pictures.npz",
    "timestamp_s [frame] f8",
    "source_index [frame] i8",
    "quarter_turns [] i8",
    "sharpness [frame] f4",
    "brightness [frame] f4",
)
MAPPED = "mapped"
"""`Clip.scale` of a recording without depth: its cameras and the room's depth come from the map, its animal's
depth is inferred, or confirmed by several views"""
MASKS = FileSchema.of("masks/masks.npz", "visible [frame] bool", "confidence [frame] f4", "area [frame] f4")
PEOPLE = FileSchema.of(
    "masks/people.npz",
    "timestamp_s [frame] f8",
    "feet_camera [frame person 3] f4",
    "ahead_camera [frame person 3] f4",
    "height_m [person] f4",
)
MIN_CONFIDENCE = 1
"""minimum confidence of usable depth: 0 is what phones report as low"""
STEP_SHARE = 0.25
"""relative depth range over 3 x 3 pixels from which a pixel is at a depth discontinuity"""


@dataclass(frozen=True)
class Clip:
    """One recording at 10 Hz: upright color, depth in meters, confidence, intrinsics, odometry."""

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
    """what makes its lengths meters: its own depth, the id of another recording whose depth does, or
    nothing: `relative`; `mapped` where cameras and depth are the map's, and so no evidence against it
    """

    @property
    def mapped(self) -> bool:
        """Return whether cameras and depth come from the map instead of its own measurements."""
        return self.scale == MAPPED

    @classmethod
    def open(cls, folder: Path) -> "Clip":
        """Open a finished ``frames/<id>`` artifact."""
        stored = [key for key in FRAMES.arrays if key in cls.__dataclass_fields__]
        table: dict = FRAMES.load(folder / "frames.npz", *stored)
        table["odometry_from_camera"] = table.get("odometry_from_camera")
        table["gravity_known"] = bool(table["gravity_known"])
        table["scale"] = str(table.get("scale", "measured"))
        color_size = images.read_color(folder / "color" / "000000.jpg").shape[:2]
        depth_size = images.read_depth(folder / "depth" / "000000.exr").shape
        return cls(folder, color_size=color_size, depth_size=depth_size, **table)

    def __len__(self) -> int:
        return len(self.timestamp_s)

    def color(self, frame: int) -> UInt8[np.ndarray, "height width 3"]:
        """Read one frame's RGB."""
        return images.read_color(self.folder / "color" / f"{frame:06d}.jpg")

    def depth(self, frame: int) -> Float[np.ndarray, "height width"]:
        """Read one frame's depth in meters, 0 = unknown, at the sensor's resolution."""
        return images.read_depth(self.folder / "depth" / f"{frame:06d}.exr")

    def confidence(self, frame: int) -> UInt8[np.ndarray, "height width"]:
        """Read one frame's depth confidence: 0 low, 1 medium, 2 high."""
        return images.read_gray(self.folder / "confidence" / f"{frame:06d}.png")

    def foreground(self, frame: int) -> UInt8[np.ndarray, "height width"]:
        """Read where the animal stands in front of the map, 255, else 0; only if `mapped`."""
        return images.read_gray(self.folder / "foreground" / f"{frame:06d}.png")


@dataclass(frozen=True)
class Pictures:
    """Upright pictures of a recording without depth, at 10 Hz."""

    folder: Path
    timestamp_s: Float[np.ndarray, "frame"]
    source_index: Int[np.ndarray, "frame"]
    quarter_turns: int
    sharpness: Float[np.ndarray, "frame"]
    brightness: Float[np.ndarray, "frame"]
    color_size: tuple[int, int]
    """(height, width) in pixels"""

    @classmethod
    def open(cls, folder: Path) -> "Pictures":
        """Open a finished ``pictures/<id>`` artifact."""
        table = PICTURES.load(folder / "pictures.npz")
        size = images.read_color(folder / "color" / "000000.jpg").shape[:2]
        turns = int(table.pop("quarter_turns"))
        return cls(folder=folder, color_size=size, quarter_turns=turns, **table)

    def __len__(self) -> int:
        return len(self.timestamp_s)

    def file(self, frame: int) -> Path:
        """Return the path of one frame's picture."""
        return self.folder / "color" / f"{frame:06d}.jpg"

    def color(self, frame: int) -> UInt8[np.ndarray, "height width 3"]:
        """Read one frame's RGB."""
        return images.read_color(self.file(frame))


@dataclass(frozen=True)
class Masks:
    """The agent's masks of one recording, at color resolution: 255 agent, 0 background, 128 unknown."""

    folder: Path
    visible: np.ndarray
    """[frame] bool: whether the agent was found"""
    confidence: Float[np.ndarray, "frame"]

    @classmethod
    def open(cls, folder: Path) -> "Masks":
        """Open a finished ``masks/<id>`` artifact."""
        table = MASKS.load(folder / "masks.npz", "visible", "confidence")
        return cls(folder, table["visible"], table["confidence"])

    def __len__(self) -> int:
        return len(self.visible)

    def __getitem__(self, frame: int) -> UInt8[np.ndarray, "height width"]:
        if not 0 <= frame < len(self):
            raise IndexError(frame)
        return images.read_gray(self.folder / f"{frame:06d}.png")


def usable_depth(
    clip: Clip, frame: int, *, nearest_m: float = 0.0, farthest_m: float = np.inf, keep_steps: bool = True
) -> Float[np.ndarray, "height width"]:
    """Read one frame's depth (meters) where it can be relied on, 0 elsewhere: the one policy of all stages.

    Out are pixels of low confidence and those outside of the range; without ``keep_steps`` also those at
    depth steps, where a sensor averages two surfaces into flying pixels.
    """
    depth = clip.depth(frame)
    usable = (clip.confidence(frame) >= MIN_CONFIDENCE) & (depth >= nearest_m) & (depth <= farthest_m)
    if not keep_steps:
        around = np.ones((3, 3), np.uint8)
        low = cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), around)
        usable &= cv2.dilate(depth, around) - low < STEP_SHARE * depth
    return np.where(usable, depth, 0).astype(np.float32)


def back_project_pixels(
    clip: Clip, frame: int, pixel: Float[np.ndarray, "point 2"], depth: Float[np.ndarray, "height width"]
) -> Float[np.ndarray, "point 3"]:
    """Back-project color pixels to the camera frame by the frame's ``depth``; NaN where there is none."""
    z = cameras.sample_nearest(depth, pixel * np.divide(depth.shape, clip.color_size)[::-1])
    points = cameras.unproject(pixel, clip.intrinsics[frame]) * z[:, None]
    return np.where((z > 0)[:, None], points, np.nan)


def read_source_index(frames: Path) -> Int[np.ndarray, "frame"]:
    """Read the number of the recorded frame behind each frame of a finished ``frames/<id>``."""
    return FRAMES.load(frames / "frames.npz", "source_index")["source_index"]
