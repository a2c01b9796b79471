"""Images on disk: colour (JPEG, PNG, WebP), 8-bit labels (PNG) and depth (EXR, one HALF channel ``Z``, metres).

The only file that decodes OpenEXR and OpenCV images. Sizes are checked before pixels are decoded:
a few hundred bytes can ask for gigabytes.
"""

import struct
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
from jaxtyping import Float, UInt8

from pipeline.errors import InputError

MAX_PIXELS = 32 << 20
MAX_DEPTH_M = 1000.0


def decode_color(data: bytes, where: str) -> UInt8[np.ndarray, "height width 3"]:
    """Decode an image file's bytes to RGB. Raises InputError CAP-020 when the bytes are not a readable image."""
    image = _decoded(data, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise InputError("CAP-020", what="the picture cannot be decoded", where=where, remedy="export the recording again")
    return image


def read_color(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    """Read an RGB picture."""
    return decode_color(Path(path).read_bytes(), str(path))


def encode_jpeg(color: UInt8[np.ndarray, "height width 3"], quality: int = 92) -> bytes:
    """Encode RGB as JPEG."""
    return cv2.imencode(".jpg", color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def write_color(path: Path, color: UInt8[np.ndarray, "height width 3"], quality: int = 92) -> None:
    """Write RGB; the ending chooses JPEG, PNG or WebP, ``quality`` counts for JPEG and WebP."""
    flags = {".jpg": [cv2.IMWRITE_JPEG_QUALITY, quality], ".webp": [cv2.IMWRITE_WEBP_QUALITY, quality]}.get(Path(path).suffix, [])
    encoded, data = cv2.imencode(Path(path).suffix, np.ascontiguousarray(color[..., ::-1]), flags)
    assert encoded, path
    Path(path).write_bytes(data.tobytes())


def read_gray(path: Path) -> UInt8[np.ndarray, "height width"]:
    """Read an 8-bit single-channel PNG (masks, confidence) with its values as they are."""
    image = _decoded(Path(path).read_bytes(), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2 or image.dtype != np.uint8:
        raise InputError(
            "CAP-021", what="not a readable 8-bit single-channel picture", where=str(path), remedy="rebuild the stage that wrote it"
        )
    return image


def write_gray(path: Path, image: UInt8[np.ndarray, "height width"]) -> None:
    """Write an 8-bit single-channel PNG."""
    assert image.dtype == np.uint8 and image.ndim == 2, (image.dtype, image.shape)
    Path(path).write_bytes(cv2.imencode(".png", image)[1].tobytes())


def read_depth(path: Path, channel: str | None = "Z") -> Float[np.ndarray, "height width"]:
    """Read a depth EXR as float32 metres, 0 where the value is not finite, not positive or absurdly far.

    Without a ``channel`` the file must have exactly one. Raises InputError CAP-022 for files that are not EXR, ask for too
    many pixels or lack the channel.
    """
    _check_exr_size(Path(path))
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            (name,) = [channel] if channel else file.channels()
            pixels = file.channels()[name].pixels.astype(np.float32)
    except (RuntimeError, KeyError, ValueError) as error:
        raise InputError(
            "CAP-022", what=f"not a depth EXR with a channel {channel!r} ({error})", where=str(path), remedy="export the recording again"
        ) from error
    return np.where(np.isfinite(pixels) & (pixels > 0) & (pixels < MAX_DEPTH_M), pixels, np.float32(0))


def write_depth(path: Path, depth: Float[np.ndarray, "height width"]) -> None:
    """Write z-depth in metres (0 = unknown) as one HALF channel ``Z``, ZIP compressed."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Z": np.ascontiguousarray(depth, np.float16)}) as file:
        file.write(str(path))


def _decoded(data: bytes, flags: int) -> np.ndarray | None:
    """Decode with OpenCV; None for what it cannot read or finds too large (``OPENCV_IO_MAX_IMAGE_PIXELS``)."""
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        return None


def _check_exr_size(path: Path) -> None:
    """Read the data window from the header and refuse sizes that no phone writes."""
    head = path.read_bytes()[:65536] if path.exists() else b""
    at = head.find(b"dataWindow\0box2i\0")
    ok = head[:4] == b"\x76\x2f\x31\x01" and 0 <= at and at + 37 <= len(head)
    if ok:
        x0, y0, x1, y1 = struct.unpack_from("<4i", head, at + 21)
        ok = x1 >= x0 and y1 >= y0 and (x1 - x0 + 1) * (y1 - y0 + 1) <= MAX_PIXELS
    if not ok:
        raise InputError("CAP-022", what="not an EXR picture of a sensible size", where=str(path), remedy="export the recording again")
