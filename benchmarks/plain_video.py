"""Take the depth away from a built-in capture: sessions and turnaround become plain videos.

    python -m benchmarks.plain_video build/toy/synthetic_capture captures/toy_plain

Writes `<name>.mp4` for sessions and turnaround, without depth, poses and lens; walk-through and held-out phone
are copied. Build it like any capture, then measure it on the truth of the built-in capture:

    cp agents/toy.toml agents/toy_plain.toml && make toy_plain
    python -m stages.evaluate.reconstruction_metrics --truth build/toy/synthetic_capture/truth ...
"""

import argparse
import shutil
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from pipeline.core.progress import log, track
from pipeline.data import images
from pipeline.recordings.formats import open_recording

CLOCK = 10_000
"""ticks per second of the movie's time stamps"""
QUALITY = {"crf": "20", "preset": "veryfast"}
"""of the encoder: about what phones record with"""
HELDOUT_SIDECAR = 'synchronized_with = "session-1.mp4"\noffset_s = 0.0\n'
"""the second phone films the toy's first session"""


def without_depth(recording: Path, movie: Path) -> None:
    """Write the pictures of a recording as an H.264 video with its own time stamps."""
    known = open_recording(recording)
    height, width = known.color_size
    with av.open(str(movie), "w") as container:
        stream = container.add_stream("libx264", rate=30, options=QUALITY)
        stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, CLOCK)
        turns = known.quarter_turns
        assert turns == 0, "the built-in capture is stored without a rotation tag"
        for number, time_s in zip(track(known.index, movie.name), known.timestamp_s, strict=True):
            stored = known.read_color(int(number))
            color = images.decode_color(stored, str(recording)) if isinstance(stored, bytes) else stored
            assert color is not None, number
            even = cv2.copyMakeBorder(color, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
            frame.pts, frame.time_base = round(float(time_s) * CLOCK), Fraction(1, CLOCK)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path, help="a finished artifact `synthetic_capture`")
    parser.add_argument("out", type=Path, help="a new folder of recordings")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True)
    for recording in sorted((arguments.capture / "recordings").glob("*.r3d")):
        if recording.stem.startswith(("walkthrough", "heldout")):
            shutil.copy(recording, arguments.out)
            if recording.stem == "heldout":
                (arguments.out / "heldout.r3d.toml").write_text(HELDOUT_SIDECAR)
        else:
            without_depth(recording, arguments.out / f"{recording.stem}.mp4")
    log(f"{len(list(arguments.out.iterdir()))} recordings in {arguments.out}")


if __name__ == "__main__":
    main()
