"""Convert sessions and turnaround of a built-in capture to plain videos without depth.

    python -m benchmarks.plain_video build/toy/synthetic_capture captures/toy_plain

Writes `<name>.mp4` for sessions and turnaround, without depth, poses and intrinsics; walk-through and held-out phone
are copied. Build it like any capture, then evaluate it against the ground truth of the built-in capture:

    cp agents/toy.toml agents/toy_plain.toml && make toy_plain
    python -m stages.evaluate.reconstruction_metrics --truth build/toy/synthetic_capture/truth ...
"""

import shutil
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from benchmarks import command_lines
from pipeline.core.progress import log, track
from pipeline.data import images
from pipeline.recordings.formats import open_recording

TICKS_HZ = 10_000
"""ticks per second of the video timestamps"""
ENCODER_OPTIONS = {"crf": "20", "preset": "veryfast"}
"""encoder options, similar to the quality of phones"""
HELDOUT_SIDECAR = 'synchronized_with = "session-1.mp4"\noffset_s = 0.0\n'
"""the held-out phone records the first session"""


def write_plain_video(recording: Path, movie: Path) -> None:
    """Write the pictures of a recording as an H.264 video with the timestamps of the recording."""
    source = open_recording(recording)
    height, width = source.color_size
    with av.open(str(movie), "w") as container:
        stream = container.add_stream("libx264", rate=30, options=ENCODER_OPTIONS)
        stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, TICKS_HZ)
        assert source.quarter_turns == 0, "the built-in capture is stored without a rotation tag"
        for number, time_s in zip(track(source.index, movie.name), source.timestamp_s, strict=True):
            stored = source.read_color(int(number))
            color = images.decode_color(stored, str(recording)) if isinstance(stored, bytes) else stored
            assert color is not None, number
            padded = cv2.copyMakeBorder(color, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(padded), format="rgb24")
            frame.pts, frame.time_base = round(float(time_s) * TICKS_HZ), Fraction(1, TICKS_HZ)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def main() -> None:
    """Parse the command line."""
    parser = command_lines.described(__doc__)
    parser.add_argument("capture", type=Path, help="a finished `synthetic_capture` artifact")
    parser.add_argument("out", type=Path, help="folder of recordings to create")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True)
    for recording in sorted((arguments.capture / "recordings").glob("*.r3d")):
        if recording.stem.startswith(("walkthrough", "heldout")):
            shutil.copy(recording, arguments.out)
            if recording.stem == "heldout":
                (arguments.out / "heldout.r3d.toml").write_text(HELDOUT_SIDECAR)
        else:
            write_plain_video(recording, arguments.out / f"{recording.stem}.mp4")
    log(f"{len(list(arguments.out.iterdir()))} recordings in {arguments.out}")


if __name__ == "__main__":
    main()
