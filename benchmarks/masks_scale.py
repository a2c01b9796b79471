"""Does the cost of masks stay linear, and their memory bounded? Repeat one session's frames and segment each
length.

    python -m benchmarks.masks_scale cat --frames 200 800

A session of a build with frames is walked forth and back as often as needed. Seconds are CPU seconds of one
process; peak memory is the process's own, each length in a process of its own.
"""

import argparse
import json
import multiprocessing
import resource
import time
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.registration_scale import There, forth_and_back
from pipeline.data.clips import Clip
from stages.segment_agent.config import Config
from stages.segment_agent.masks import segment


def measure(build: Path, video: str, frames: int) -> tuple[float, float, float]:
    """Return CPU seconds, peak memory in MB, and the share of frames in which the animal is seen."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    clip = Clip.open(build / "frames" / video)
    start = time.process_time()
    masks = segment(
        There(clip, forth_and_back(len(clip), frames)),
        build / "flow" / video,
        "session",
        None,
        Config(),
        np.random.default_rng(0),
    ).masks
    seen = np.mean([mask.visible for mask in masks])
    return time.process_time() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, float(seen)


def main() -> None:
    """Print the table of one session of an agent's build."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("agent", help="whose build, for example cat")
    parser.add_argument("--build", type=Path, default=Path("build"), help="where builds lie")
    parser.add_argument("--frames", type=int, nargs="+", default=[200, 800, 3200], help="lengths")
    given = parser.parse_args()
    build = given.build / given.agent
    videos = json.loads((build / "plan" / "videos.json").read_text())
    video = next(video["id"] for video in videos if video["role"] == "session")
    print("| frames | s | s / frame | peak MB | animal seen |\n|---|---|---|---|---|", flush=True)
    for frames in given.frames:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            seconds, peak_mb, seen = pool.apply(measure, (build, video, frames))
        print(
            f"| {frames} | {seconds:.0f} | {seconds / frames:.3f} | {peak_mb:.0f} | {seen:.2f} |", flush=True
        )


if __name__ == "__main__":
    main()
