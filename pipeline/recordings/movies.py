"""Random access to frames of video files with any codec that PyAV decodes, skipping damaged ones.

Frames are identified by presentation timestamp (PTS), read from the packets without decoding, so that a frame
lost to damage does not shift the others.
"""

import contextlib
import itertools
from collections.abc import Iterator
from pathlib import Path

import av
import av.container
import av.error
import cv2
import numpy as np
from av.stream import Disposition
from av.video.reformatter import ColorPrimaries, Colorspace, ColorTrc, VideoReformatter
from jaxtyping import Float, UInt8

from pipeline.core.errors import InputError
from pipeline.data.images import MAX_PIXELS
from pipeline.recordings import errors

_GUARDS = {
    "format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm",
    "protocol_whitelist": "file",
    "max_pixels": str(MAX_PIXELS),
}
"""refuses playlists of other files (ffconcat, HLS) and pictures larger than any phone's"""
SKIP_FRAMES = 90
"""frames to decode ahead sequentially; beyond, the decoder seeks to the nearest key frame"""
CAPTURE_RATE = "com.android.capture.fps"
"""Android's metadata tag of the capture frame rate, which may differ from the playback rate"""
MIN_SLOWDOWN = 3.0
"""ratio of capture to playback rate from which a video is slow motion (or its inverse, time lapse); dim light
halves the rate of an ordinary video"""
MAX_ASPECT = 2.0
"""maximum pixel aspect ratio; a larger one is a broken header"""
HDR = (ColorTrc.ARIB_STD_B67, ColorTrc.SMPTE2084)
"""transfer curves of video with a high dynamic range: HLG (iPhone, also Dolby Vision), PQ (HDR10, HDR10+)"""
WIDE = (ColorPrimaries.SMPTE432, ColorPrimaries.SMPTE431, ColorPrimaries.BT2020)
"""primaries of wider gamuts than sRGB's: Display P3, DCI-P3 and BT.2020"""
MIN_CUT_S = 0.5
"""least difference between a file's declared duration and its end that counts as a copy that was cut off"""
UNSPECIFIED, HD_ROWS = 2, 720
"""code of an unnamed color matrix (ITU-T H.273), and the height from which such video is read by the matrix
of BT.709, as players do; below it, and in MJPEG, by that of BT.601"""


class Movie:
    """A video whose frames are read by number, fastest in order; optionally resampled to square pixels."""

    def __init__(self, path: Path, *, square_pixels: bool = False) -> None:
        self.where = str(path)
        self._path = path
        with self._opened() as (container, stream):
            times, end_s = _packet_times(container, stream)
            if not times or stream.time_base is None:
                raise errors.no_frames(self.where, "the video is empty")
            # listed beyond the end of a file that was not copied completely
            size = path.stat().st_size
            missing = {each.timestamp for each in stream.index_entries if each.pos + each.size > size}
            missing |= _undelivered(container, stream, times, end_s)
            self._pts = np.array(sorted(times | missing))
            self.complete = np.flatnonzero(~np.isin(self._pts, sorted(missing)))
            self.remarks = self._cut_off_remarks(float(stream.time_base))
            shown_s = (self._pts - self._pts[0]) * float(stream.time_base)
            self.timestamp_s = shown_s / _slowdown(shown_s, container.metadata.get(CAPTURE_RATE, ""))
            aspect = float(stream.sample_aspect_ratio or 1) if square_pixels else 1.0
            self._hd = min(stream.width, stream.height) >= HD_ROWS and stream.codec_context.name != "mjpeg"
        self._decoder: Iterator[av.VideoFrame] | None = None
        self._position = 0
        self._tone_mapper = VideoReformatter()
        first = next(self._decoded_from(0), None)
        if first is None:
            raise errors.damaged(self.where, "no frame of the video can be decoded")
        stretch = aspect if 1 / MAX_ASPECT <= aspect <= MAX_ASPECT else 1.0
        self.size = (first.height, round(first.width * stretch))
        self.quarter_turns = _quarter_turns(first)

    def __len__(self) -> int:
        return len(self._pts)

    def read(self, number: int) -> UInt8[np.ndarray, "height width 3"] | None:
        """Return one frame as RGB, as stored (not rotated); None if it is damaged."""
        if self._decoder is None or number < self._position or number > self._position + SKIP_FRAMES:
            self._decoder = self._decoded_from(number)
        wanted = int(self._pts[number])
        self._position = number + 1
        for frame in self._decoder:
            if frame.pts is None or frame.pts < wanted:
                continue
            if frame.pts > wanted:  # the wanted frame is lost; keep this one for the next call
                self._decoder = itertools.chain([frame], self._decoder)
                return None
            return None if frame.is_corrupt else self._rgb(frame)
        self._decoder = iter(())
        return None

    def _cut_off_remarks(self, unit_s: float) -> tuple[str, ...]:
        """Say which frames a copy that was cut off lacks. Raises CAP-001 if these are most."""
        lost, last = len(self) - len(self.complete), self._pts[self.complete[-1:]].max(initial=self._pts[0])
        end_s, declared_s = (unit_s * (each - self._pts[0]) for each in (last, self._pts[-1]))
        ends = f"the pictures end after {end_s:.1f} of {declared_s:.1f} s"
        if lost > len(self.complete):
            raise errors.damaged(self.where, ends)
        return (f"{ends}: {lost} of {len(self)} are missing, copy it again",) if lost else ()

    def _rgb(self, frame: av.VideoFrame) -> UInt8[np.ndarray, "height width 3"]:
        """Convert to 8 bits and sRGB, clipped above diffuse white (203 cd/m2, ITU-R BT.2408); deinterlace."""
        (height, width), hdr = self.size, frame.color_trc in HDR
        if self._hd and frame.colorspace == UNSPECIFIED:
            frame.colorspace = Colorspace.ITU709
        converted = hdr or frame.color_primaries in WIDE
        kind = "gbrp16le" if converted else "rgb24"  # FFmpeg 8 mixes channels of rgb48le where widths are odd
        rgb = frame.to_ndarray(format=kind, width=width, height=height)
        if converted:
            plain = av.VideoFrame.from_ndarray(rgb, format=kind)  # without its peak, which would become white
            plain.color_trc = frame.color_trc if hdr else ColorTrc.IEC61966_2_1
            plain.color_primaries = frame.color_primaries
            target = {"dst_color_trc": ColorTrc.IEC61966_2_1, "dst_color_primaries": ColorPrimaries.BT709}
            rgb = self._tone_mapper.reformat(plain, format="rgb24", **target).to_ndarray()
        return cv2.resize(rgb[::2], (width, height)) if frame.interlaced_frame else rgb

    def _decoded_from(self, number: int) -> Iterator[av.VideoFrame]:
        """Yield decoded frames, starting at or before frame ``number``.

        In an open GOP (usual in HEVC) frames shown before a key frame are stored after it and refer to the
        previous key frame: seek further back until frame ``number`` is not skipped.
        """
        start = number
        while True:
            decoder = self._decoded_from_key_frame(start)
            first = next(decoder, None)
            if not start or (first is not None and (first.pts or 0) <= self._pts[number]):
                return itertools.chain(() if first is None else (first,), decoder)
            start = max(2 * start - number - 1, 0)

    def _decoded_from_key_frame(self, number: int) -> Iterator[av.VideoFrame]:
        """Yield decoded frames from the key frame at or before ``number``, skipping damaged packets."""
        with self._opened() as (container, stream), contextlib.suppress(av.error.FFmpegError):
            if number:
                container.seek(int(self._pts[number]), stream=stream, backward=True)
            for packet in container.demux(stream):
                with contextlib.suppress(av.error.FFmpegError):
                    yield from packet.decode()

    @contextlib.contextmanager
    def _opened(self) -> Iterator[tuple[av.container.InputContainer, av.VideoStream]]:
        """Open the file and its main video."""
        try:
            container = av.open(str(self._path), options=_GUARDS, metadata_errors="replace")
        except (av.error.FFmpegError, OSError) as error:
            raise errors.unreadable(self.where, error) from error
        with container:
            if not container.streams.video:
                raise errors.no_frames(self.where, "the file holds no pictures")
            stream = max(container.streams.video, key=_rank)
            codec = stream.codec_context
            if codec is None:
                raise errors.damaged(self.where, "the video is of an unknown codec")
            if codec.width * codec.height > MAX_PIXELS:
                what = f"pictures of {codec.width} x {codec.height}, larger than any phone's"
                raise InputError("CAP-001", what, self.where, "export it in 4K")
            yield container, stream


def _rank(stream: av.VideoStream) -> tuple[bool, int]:
    """Order a file's videos: covers and stills of live photos, previews and other smaller ones, the main."""
    codec, cover = stream.codec_context, stream.disposition & Disposition.attached_pic
    return stream.frames != 1 and not cover, 0 if codec is None else codec.width * codec.height


def _quarter_turns(frame: av.VideoFrame) -> int:
    """Return the clockwise quarter turns to upright; a picture mirrored for display is left as it is."""
    matrix = frame.side_data.get("DISPLAYMATRIX")
    down_x, down_y = (0, 1) if matrix is None else np.frombuffer(bytes(matrix), np.int32)[3:5].tolist()
    return round(np.arctan2(-down_x, down_y) / (np.pi / 2)) % 4


def _undelivered(
    container: av.container.InputContainer, stream: av.VideoStream, times: set[int], end_s: float
) -> set[int]:
    """Return about the times of frames that Matroska declares beyond the end of its last packet.

    Its index stands at the end of the file. A duration that FFmpeg only estimates is the streams' own too.
    """
    declared = container.duration if container.format.name.startswith("matroska") else None
    if not declared or not stream.time_base or stream.duration is not None or len(times) == 1:
        return set()
    shown, missing_s = np.array(sorted(times)), declared / av.time_base - end_s
    step_s = float(np.median(np.diff(shown)) * stream.time_base)
    if missing_s < MIN_CUT_S + step_s:
        return set()
    count = min(round(missing_s / step_s), len(shown) + 1)
    step = missing_s / count / float(stream.time_base)
    return {round(shown[-1] + step * (1 + number)) for number in range(count)}


def _slowdown(shown_s: Float[np.ndarray, "frame"], capture_rate: str) -> float:
    """Return a video's slow-motion factor by its metadata tag; 1 without a tag."""
    try:
        slowdown = float(capture_rate) * float(np.median(np.diff(shown_s)))
    except ValueError:
        return 1.0
    return slowdown if MIN_SLOWDOWN <= max(slowdown, 1 / max(slowdown, 1e-9)) < np.inf else 1.0


def _packet_times(container: av.container.InputContainer, stream: av.VideoStream) -> tuple[set[int], float]:
    """Return the PTS of all frames except those hidden by an edit list, which only serve as references, and
    the end of the last packet of any stream, seconds.
    """
    times, end_s = set(), 0.0
    with contextlib.suppress(av.error.FFmpegError):
        for packet in container.demux():
            if packet.pts is None or packet.time_base is None or not packet.size:
                continue
            end_s = max(end_s, float((packet.pts + (packet.duration or 0)) * packet.time_base))
            if packet.stream is stream and not packet.is_discard:
                times.add(packet.pts)
    return times, end_s
