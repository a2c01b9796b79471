"""Images on disk: color (JPEG, PNG, WebP), 8-bit labels (PNG), depth (EXR, one HALF channel ``Z``, meters).

The only file that decodes OpenEXR and OpenCV images. Sizes are checked before pixels are decoded:
a few hundred bytes can ask for gigabytes.
"""

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
from jaxtyping import Float, Shaped, UInt8

from pipeline.core.errors import InputError

MAX_PIXELS = 32 << 20
"""limit for a color picture, and for all channels of a depth picture: 8K video, more than any phone's"""
SRGB_SLOPE, SRGB_OFFSET, SRGB_GAMMA, SRGB_KNEE = 12.92, 0.055, 2.4, 0.0031308
"""The transfer curve of sRGB (IEC 61966-2-1); the knee in linear intensity."""
MAX_DEPTH_M = 1000.0
"""maximum plausible depth, meters"""
MAX_EXR_BYTES = 4 * MAX_PIXELS + (1 << 16)
"""limit for a depth picture's file: uncompressed floats and a header"""
PNG_CHUNK_BYTES = 12
"""Length, type and checksum around a chunk's data."""
STARTS_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""JPEG start of frame markers, which precede the size of the picture."""
EXPORT_AGAIN = "export the recording again"


def decode_color(data: bytes, where: str) -> UInt8[np.ndarray, "height width 3"]:
    """Decode an image file's bytes to RGB. Raises InputError CAP-020 if they are not a readable image."""
    image = decoded(data, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise InputError("CAP-020", "the picture cannot be decoded", where, EXPORT_AGAIN)
    return image


def read_color(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    """Read an RGB picture, 0..255."""
    return decode_color(Path(path).read_bytes(), str(path))


def encode_jpeg(color: UInt8[np.ndarray, "height width 3"], quality: int = 92) -> bytes:
    """Encode RGB as JPEG."""
    return cv2.imencode(".jpg", color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def write_color(path: Path, color: UInt8[np.ndarray, "height width 3"], quality: int = 92) -> None:
    """Write RGB as JPEG, PNG or WebP, by suffix; ``quality`` applies to JPEG and WebP."""
    flags = {".jpg": [cv2.IMWRITE_JPEG_QUALITY, quality], ".webp": [cv2.IMWRITE_WEBP_QUALITY, quality]}
    kind = Path(path).suffix
    encoded, data = cv2.imencode(kind, np.ascontiguousarray(color[..., ::-1]), flags.get(kind, []))
    assert encoded, path
    Path(path).write_bytes(data.tobytes())


def read_gray(path: Path) -> UInt8[np.ndarray, "height width"]:
    """Read an 8-bit single-channel PNG (masks, confidence) with its values as they are."""
    image = decoded(Path(path).read_bytes(), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2 or image.dtype != np.uint8:
        what = "not a readable 8-bit single-channel picture"
        raise InputError("CAP-021", what, str(path), "rebuild the stage that wrote it")
    return image


def write_gray(path: Path, image: UInt8[np.ndarray, "height width"]) -> None:
    """Write an 8-bit single-channel PNG."""
    assert image.dtype == np.uint8 and image.ndim == 2, (image.dtype, image.shape)
    Path(path).write_bytes(cv2.imencode(".png", image)[1].tobytes())


def read_depth(path: Path, channel: str | None = "Z") -> Float[np.ndarray, "height width"]:
    """Read a depth EXR as float32 meters, 0 where the value is not finite, not positive or absurdly far.

    Without a ``channel`` the file must have exactly one. Raises InputError CAP-022 for files that are not
    EXR, ask for too many pixels or lack the channel.
    """
    _check_exr_size(Path(path))
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            (name,) = [channel] if channel else file.channels()
            pixels = file.channels()[name].pixels.astype(np.float32)
    except (RuntimeError, KeyError, ValueError, TypeError, MemoryError) as error:
        what = f"not a depth EXR with a channel {channel!r} ({error})"
        raise InputError("CAP-022", what, str(path), EXPORT_AGAIN) from error
    return np.where(np.isfinite(pixels) & (pixels > 0) & (pixels < MAX_DEPTH_M), pixels, np.float32(0))


def write_depth(path: Path, depth: Float[np.ndarray, "height width"]) -> None:
    """Write z-depth in meters (0 = unknown) as one HALF channel ``Z``, ZIP compressed."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()  # OpenEXR ignores a full disk when it closes a file
    with OpenEXR.File(header, {"Z": np.ascontiguousarray(depth, np.float16)}) as file:
        file.write(stream)
    Path(path).write_bytes(stream.getvalue())


def decoded(data: bytes, flags: int) -> Shaped[np.ndarray, "height width *channel"] | None:
    """Decode with OpenCV; None for unreadable files, PNG with wrong checksums and more than `MAX_PIXELS`."""
    try:
        if _declared_pixels(data) > MAX_PIXELS:
            return None
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (cv2.error, struct.error):
        return None


def _declared_pixels(data: bytes) -> int:
    """Return the number of pixels that a PNG or JPEG declares; 0 for others, too many for a broken PNG."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        at, kind = 8, b""
        while kind != b"IEND":  # OpenCV allocates the declared size of a chunk before reading it
            length, kind = struct.unpack_from(">I4s", data, at)
            at += PNG_CHUNK_BYTES + length
            if zlib.crc32(data[at - length - 8 : at - 4]) != struct.unpack_from(">I", data, at - 4)[0]:
                return MAX_PIXELS + 1
        width, height = struct.unpack_from(">2I", data, 16)
        return width * height
    at = 2
    while data[:2] == b"\xff\xd8" and data[at : at + 1] == b"\xff":
        marker, length = struct.unpack_from(">BH", data, at + 1)
        if marker in STARTS_OF_FRAME:
            height, width = struct.unpack_from(">2H", data, at + 5)
            return height * width
        at += 2 + length
    return 0


def _check_exr_size(path: Path) -> None:
    """Check size and channels in the header before pixels are decoded."""
    try:
        if good := path.stat().st_size <= MAX_EXR_BYTES:
            with OpenEXR.File(str(path), header_only=True) as file:
                (part,) = file.parts
                width, height = np.diff(np.array(part.header["dataWindow"], int), axis=0)[0].tolist()
                pixels = (width + 1) * (height + 1) * len(part.header["channels"])
                flat = part.type() in (OpenEXR.scanlineimage, OpenEXR.tiledimage)
                good = flat and min(width, height) >= 0 and pixels <= MAX_PIXELS
    except (OSError, RuntimeError, ValueError, KeyError):
        good = False
    if not good:
        raise InputError("CAP-022", "not an EXR picture of a sensible size", str(path), EXPORT_AGAIN)


def linear_from_srgb(srgb: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """Return linear intensities of sRGB values, both 0..1 (IEC 61966-2-1)."""
    low = srgb / SRGB_SLOPE
    return np.where(low <= SRGB_KNEE, low, ((srgb + SRGB_OFFSET) / (1 + SRGB_OFFSET)) ** SRGB_GAMMA)


def srgb_from_linear(linear: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """Return sRGB values of linear intensities, both 0..1 (IEC 61966-2-1)."""
    high = (1 + SRGB_OFFSET) * np.maximum(linear, 0) ** (1 / SRGB_GAMMA) - SRGB_OFFSET
    return np.where(linear <= SRGB_KNEE, SRGB_SLOPE * linear, high)
