"""Measure how time and memory of registration scale with the length of a recording.

    python -m benchmarks.registration_scale cat --frames 200 600 1800 5000

The frames of one session are repeated, alternately forward and backward so that motions stay continuous, up to each
length. Each length runs in its own process; CPU seconds and peak memory are those of that process.
"""

import resource
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Int

from benchmarks import command_lines
from pipeline.data import ply
from pipeline.data.clips import Clip, Masks
from pipeline.data.features import open_features
from pipeline.data.templates import read_vertex_features
from pipeline.localization import localizer
from stages.register_videos import registration
from stages.register_videos.config import Config


@dataclass(frozen=True)
class RepeatedClip:
    """A `Clip` whose frames are repeated in a given order."""

    clip: Clip
    order: np.ndarray
    """[frame] index into the clip"""

    def __getattr__(self, name: str):
        value = getattr(self.clip, name)
        return value[self.order] if isinstance(value, np.ndarray) and len(value) == len(self.clip) else value

    def __len__(self) -> int:
        return len(self.order)

    @property
    def timestamp_s(self) -> np.ndarray:
        """Evenly spaced timestamps, 10 Hz."""
        return np.arange(len(self.order)) * 0.1

    def color(self, frame: int):
        """Read the color of a frame."""
        return self.clip.color(int(self.order[frame]))

    def depth(self, frame: int):
        """Read the depth of a frame."""
        return self.clip.depth(int(self.order[frame]))

    def confidence(self, frame: int):
        """Read the depth confidence of a frame."""
        return self.clip.confidence(int(self.order[frame]))


@dataclass(frozen=True)
class RepeatedRows:
    """Features or masks of a `RepeatedClip`, read on access."""

    rows: np.ndarray | Masks
    order: np.ndarray

    def __getitem__(self, frame: int):
        return self.rows[int(self.order[frame])]


@dataclass(frozen=True)
class RepeatedMasks(RepeatedRows):
    """Masks of a `RepeatedClip`."""

    rows: Masks

    @property
    def visible(self) -> np.ndarray:
        """Whether the animal is visible, per frame."""
        return self.rows.visible[self.order]


def repeat_frames(length: int, frames: int) -> Int[np.ndarray, "frame"]:
    """Return indices of a clip of ``length`` frames, alternately forward and backward."""
    phase = np.arange(frames) % (2 * length - 2)
    return np.where(phase < length, phase, 2 * length - 2 - phase)


def measure(build: Path, video: str, frames: int) -> tuple[float, float, bool]:
    """Return CPU seconds, peak memory in MB, and whether the recording was registered."""
    cv2.setNumThreads(1)
    clip, masks = Clip.open(build / "frames" / video), Masks.open(build / "masks" / video)
    order = repeat_frames(len(clip), frames)
    maps = registration.Maps(
        ply.read_ply(build / "scene_template" / "mesh.ply"),
        ply.read_ply(build / "agent_template" / "agent.ply"),
        localizer.load(build / "scene_localizer"),
        localizer.load(build / "agent_localizer"),
        read_vertex_features(build / "scene_template").astype(np.float32),
    )
    features = open_features(build / "features" / video)
    start = time.process_time()
    found = registration.register(
        RepeatedClip(clip, order),
        RepeatedMasks(masks, order),
        maps,
        Config(),
        np.random.default_rng(0),
        RepeatedRows(features, order),
    )
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return time.process_time() - start, peak_mb, isinstance(found, registration.Registered)


def main() -> None:
    """Print the table for one session of a build."""
    parser = command_lines.for_agent(__doc__)
    parser.add_argument(
        "--frames", type=int, nargs="+", default=[200, 600, 1800, 5000], help="lengths to measure"
    )
    arguments = parser.parse_args()
    build = command_lines.build_of(arguments)
    video = command_lines.recordings(build, "session")[0]
    print("| frames | s | s / frame | peak MB | registered |\n|---|---|---|---|---|", flush=True)
    for frames in arguments.frames:
        seconds, peak_mb, registered = command_lines.in_own_process(measure, build, video, frames)
        print(
            f"| {frames} | {seconds:.0f} | {seconds / frames:.3f} | {peak_mb:.0f} | {'yes' if registered else 'no'} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
