"""Video files by frame number: any codec that PyAV reads, damaged places left out, nothing held in memory.

Frames are identified by their presentation time, read from the packets without decoding: a frame that a
damaged place swallows shifts no other.
"""

import contextlib
import itertools
from collections.abc import Iterator
from pathlib import Path

import av
import av.container
import av.error
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.data.images import MAX_PIXELS
from pipeline.recordings.recording import damaged, no_frames

_GUARDS = {
    "format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm",
    "protocol_whitelist": "file",
    "max_pixels": str(MAX_PIXELS),
}
"""a list of other files (ffconcat, HLS) is no video, pictures larger than any phone's are not decoded"""
SKIP_FRAMES = 90
"""further ahead than this, decoding begins anew at the nearest key frame"""
CAPTURE_RATE = "com.android.capture.fps"
"""tag of Android: pictures taken per second, however many are shown per second"""
CLEARLY_SLOWED = 3.0
"""dim light halves the rate of an ordinary video; from this factor on it is slow motion, or time lapse"""
MAX_ASPECT = 2.0
"""of a pixel's sides; a camera's are less unequal, more is a broken header"""


class Movie:
    """A video whose frames are read by number, cheapest in order; stretched to square pixels on request."""

    def __init__(self, path: Path, *, square_pixels: bool = False) -> None:
        self.where = str(path)
        self._path = path
        with self._opened() as container:
            stream = container.streams.video[0]
            times = sorted(set(_packet_times(container, stream)))
            if not times or stream.time_base is None:
                raise no_frames(self.where, "the video is empty")
            self._pts = np.array(times)
            shown_s = (self._pts - self._pts[0]) * float(stream.time_base)
            self.timestamp_s = shown_s / _slowed(shown_s, container.metadata.get(CAPTURE_RATE, ""))
            aspect = float(stream.sample_aspect_ratio or 1) if square_pixels else 1.0
        self._decoder: Iterator[av.VideoFrame] | None = None
        self._position = 0
        first = self._first()
        stretch = aspect if 1 / MAX_ASPECT <= aspect <= MAX_ASPECT else 1.0
        self.size = (first.height, round(first.width * stretch))
        self.quarter_turns = round(-first.rotation / 90) % 4

    def __len__(self) -> int:
        return len(self._pts)

    def read(self, number: int) -> UInt8[np.ndarray, "height width 3"] | None:
        """Return one frame as RGB, as stored (not turned); None where the file is damaged there."""
        if self._decoder is None or number < self._position or number > self._position + SKIP_FRAMES:
            self._decoder = self._decoded_from(number)
        wanted = int(self._pts[number])
        self._position = number + 1
        for frame in self._decoder:
            if frame.pts is None or frame.pts < wanted:
                continue
            if frame.pts > wanted:  # the wanted one is lost; this one may be asked for next
                self._decoder = itertools.chain([frame], self._decoder)
                return None
            height, width = self.size
            return None if frame.is_corrupt else frame.to_ndarray(format="rgb24", width=width, height=height)
        self._decoder = iter(())
        return None

    def _first(self) -> av.VideoFrame:
        frame = next((frame for frame in self._decoded_from(0)), None)
        if frame is None:
            raise damaged(self.where, "no frame of the video can be decoded")
        return frame

    def _decoded_from(self, number: int) -> Iterator[av.VideoFrame]:
        """Yield decoded frames from one at or before a number on.

        Pictures shown before a key frame may be stored behind it and need the key frame before (open groups
        of pictures, usual in HEVC): decoding begins earlier until nothing before the number is missing.
        """
        start = number
        while True:
            decoder = self._sought(start)
            first = next(decoder, None)
            if not start or (first is not None and (first.pts or 0) <= self._pts[number]):
                return itertools.chain(() if first is None else (first,), decoder)
            start = max(2 * start - number - 1, 0)

    def _sought(self, number: int) -> Iterator[av.VideoFrame]:
        """Yield decoded frames from the key frame that is found for a number, stepping over damage."""
        with self._opened() as container:
            stream = container.streams.video[0]
            if number:
                container.seek(int(self._pts[number]), stream=stream, backward=True)
            packets = container.demux(stream)
            while True:
                try:
                    packet = next(packets, None)
                    if packet is None:
                        return
                    yield from packet.decode()
                except av.error.EOFError:
                    return
                except av.error.FFmpegError:
                    continue

    @contextlib.contextmanager
    def _opened(self) -> Iterator[av.container.InputContainer]:
        try:
            container = av.open(str(self._path), options=_GUARDS, metadata_errors="replace")
        except (av.error.FFmpegError, OSError) as error:
            raise damaged(self.where, f"not a readable video: {error.strerror or error}") from error
        with container:
            if not container.streams.video:
                raise no_frames(self.where, "the file holds no pictures")
            codec = container.streams.video[0].codec_context
            if codec is None:
                raise damaged(self.where, "the video is of an unknown codec")
            if codec.width * codec.height > MAX_PIXELS:
                why = f"pictures of {codec.width} x {codec.height}, larger than any phone's"
                raise damaged(self.where, why)
            yield container


def _slowed(shown_s: Float[np.ndarray, "frame"], capture_rate: str) -> float:
    """Return how many times slower than life a video is shown, by its tag; 1 where it has none."""
    try:
        slowed = float(capture_rate) * float(np.median(np.diff(shown_s)))
    except ValueError:
        return 1.0
    return slowed if CLEARLY_SLOWED <= max(slowed, 1 / max(slowed, 1e-9)) < np.inf else 1.0


def _packet_times(container: av.container.InputContainer, stream: av.VideoStream) -> Iterator[int]:
    """Yield the times of all frames but those that an edit list hides: never shown, decoded for others."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
        except av.error.FFmpegError:
            return
        if packet is None:
            return
        if packet.pts is not None and packet.size and not packet.is_discard:
            yield packet.pts
