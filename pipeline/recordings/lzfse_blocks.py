"""Read how much an LZFSE stream will unpack to, before unpacking it: every block says so in its header."""

import struct

_END = b"bvx$"


class BrokenBlockError(ValueError):
    """The stream is cut or is no LZFSE."""


def unpacked_bytes(data: bytes) -> int:
    """Add up the sizes that the blocks' headers declare. Raises BrokenBlockError."""
    at, total = 0, 0
    while data[at : at + 4] != _END:
        raw, length = _block(data, at)
        if length < 8:
            raise BrokenBlockError("empty block")
        at, total = at + length, total + raw
    return total


def _block(data: bytes, at: int) -> tuple[int, int]:
    """Return (unpacked bytes, stored bytes with the header) of the block at an offset."""
    try:
        match data[at : at + 4]:
            case b"bvx-":
                (raw,) = struct.unpack_from("<I", data, at + 4)
                return raw, 8 + raw
            case b"bvxn":
                raw, payload = struct.unpack_from("<2I", data, at + 4)
                return raw, 12 + payload
            case b"bvx1":
                raw, payload = struct.unpack_from("<2I", data, at + 4)
                return raw, 772 + payload
            case b"bvx2":
                raw, first, second, third = struct.unpack_from("<I3Q", data, at + 4)
                literals, matches = first >> 20 & 0xFFFFF, second >> 40 & 0xFFFFF
                return raw, (third & 0xFFFFFFFF) + literals + matches
    except struct.error as error:
        raise BrokenBlockError("cut short") from error
    raise BrokenBlockError("unknown block" if data[at : at + 4] else "cut short")
