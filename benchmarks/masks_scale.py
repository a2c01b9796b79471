"""Measure how time and memory of segmentation scale with the length of a recording.

    python -m benchmarks.masks_scale cat --frames 200 800

The frames of one session are repeated, alternately forward and backward, up to each length. Each length runs in its
own process; CPU seconds and peak memory are those of that process.
"""

import resource
import time
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks import command_lines
from benchmarks.registration_scale import RepeatedClip, repeat_frames
from pipeline.data.clips import Clip
from stages.segment_agent.config import Config
from stages.segment_agent.masks import segment


def measure(build: Path, video: str, frames: int) -> tuple[float, float, float]:
    """Return CPU seconds, peak memory in MB, and the fraction of frames with the animal."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    clip = Clip.open(build / "frames" / video)
    start = time.process_time()
    masks = segment(
        RepeatedClip(clip, repeat_frames(len(clip), frames)),
        build / "flow" / video,
        "session",
        None,
        Config(),
        np.random.default_rng(0),
    ).masks
    seen = np.mean([mask.visible for mask in masks])
    return time.process_time() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, float(seen)


def main() -> None:
    """Print the table for one session of a build."""
    parser = command_lines.for_agent(__doc__)
    parser.add_argument("--frames", type=int, nargs="+", default=[200, 800, 3200], help="lengths to measure")
    arguments = parser.parse_args()
    build = command_lines.build_of(arguments)
    video = command_lines.recordings(build, "session")[0]
    print("| frames | s | s / frame | peak MB | animal seen |\n|---|---|---|---|---|", flush=True)
    for frames in arguments.frames:
        seconds, peak_mb, seen = command_lines.in_own_process(measure, build, video, frames)
        print(
            f"| {frames} | {seconds:.0f} | {seconds / frames:.3f} | {peak_mb:.0f} | {seen:.2f} |", flush=True
        )


if __name__ == "__main__":
    main()
