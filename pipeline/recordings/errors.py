"""The errors that several readers of recordings raise."""

from collections.abc import Collection

from pipeline.core.errors import InputError


def damaged(where: str, why: str) -> InputError:
    """Return the error for a damaged or truncated file."""
    what = f"the recording is damaged or was not copied completely ({why})"
    return InputError("CAP-001", what, where, "export it from the phone again")


def unreadable(where: str, error: Exception) -> InputError:
    """Return the error for a file that cannot be read: SYS-003 without access, else it counts as damaged."""
    why = str(getattr(error, "strerror", None) or error)
    if isinstance(error, PermissionError):
        return InputError("SYS-003", f"the recording cannot be read: {why}", where, "check who may read it")
    return damaged(where, why)


def broken_metadata(where: str, why: str) -> InputError:
    """Return the error for invalid metadata, as after a change of the format."""
    remedy = "export it again, or correct it if written by hand; if a newer app wrote it, report its version"
    return InputError("CAP-004", f"the recording's metadata cannot be used: {why}", where, remedy)


def no_depth(where: str, why: str) -> InputError:
    """Return the error for recordings without depth."""
    remedy = "record with a LiDAR phone, or add a depth picture per frame: see the README's table of formats"
    return InputError("CAP-006", f"no depth: {why}", where, remedy)


def no_frames(where: str, why: str) -> InputError:
    """Return the error for recordings without a complete frame."""
    return InputError("CAP-007", f"no usable frames: {why}", where, "record some seconds, export again")


def wrong_depth(where: str, why: str) -> InputError:
    """Return the error for a depth picture of a wrong size or type."""
    return InputError("CAP-008", f"a depth picture is wrong: {why}", where, "export it from the phone again")


def refuse_other_size(shape: tuple[int, ...], size: tuple[int, int] | None, where: str) -> None:
    """Raise CAP-008 for a depth picture whose (height, width) is not ``size``, if given."""
    if size is not None and shape != size:
        raise wrong_depth(where, f"{shape[1]} x {shape[0]} instead of {size[1]} x {size[0]}")


def refuse_numbers_from_1(numbers: Collection[int], frames: int, what: str, where: str) -> None:
    """Raise CAP-004 if ``frames`` frames are numbered from 1: each would get the data of its neighbor."""
    if frames and (min(numbers, default=0), max(numbers, default=0)) == (1, frames):
        counted = f"{what} is numbered from 1 to {frames}, frames from 0"
        raise InputError("CAP-004", counted, where, "number it, and what belongs to it, from 0")
