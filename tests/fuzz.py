"""Fuzz every reader of user files: mutated files must give a result or an `InputError`.

make fuzz        or: python -m tests.fuzz --inputs 200 --seconds 120 --seed 0 [reader ...]

A reader may take 20 seconds and 2 GB per input. The same seed gives the same inputs; failing inputs are kept in
`build/fuzz/<reader>-<seed>-<number>/` and reported. The exit code is 1 if any input failed.
"""

import argparse
import re
import shutil
import signal
import sys
import tempfile
import time
import traceback
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.calibration import given
from pipeline.core import config
from pipeline.core.errors import InputError
from pipeline.data import clicks, gaussian_ply, images, npz, ply
from pipeline.geometry.meshes import Mesh
from pipeline.recordings import extraction
from pipeline.recordings.formats import open_recording
from pipeline.workflow import captures
from stages.read_trajectories import tables
from tests.pipeline.recordings import made_formats
from tests.stages.extract_frames.made_recordings import walk

MAX_S, MAX_KB = 20, 2 << 20
FAILURES = Path("build", "fuzz")
RESET, STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")
HOSTILE = (
    b"9" * 400, b"-1", b"0", b"1e300", b"1e-320", b"nan", b"inf", b"[]", b"{}", b"null", b'"x"', b"[" * 3000, b"\xff\xfe", b"",
    b"65535", b"4294967295", b"2147483648", b"-0", b"\0" * 64, b"../x", b"true",
)  # fmt: skip
"""replacements of numbers and byte ranges"""


@dataclass(frozen=True)
class Reader:
    """One kind of user file: functions that write a valid one and read it."""

    make: Callable[[Path], Path]
    read: Callable[[Path], object]


def _recording(path: Path) -> None:
    recording = open_recording(path)
    plan = extraction.understand(recording, rate_hz=10.0, max_depth_m=6.0, max_side_px=640)
    for _, frame in zip(range(2), extraction.frames(recording, plan, max_depth_m=6.0), strict=False):
        assert frame is None or frame.depth.ndim == 2


def _exr(path: Path) -> Path:
    images.write_depth(path, np.linspace(0.5, 3, 48 * 64).reshape(48, 64))
    return path


def _npz(path: Path) -> Path:
    npz.save(path, time_s=np.arange(40.0), place=np.ones((40, 3), np.float32), name=np.array("cat"))
    return path


def _ply(path: Path) -> Path:
    ply.write_ply(
        path, Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), np.full((3, 3), 9, np.uint8))
    )
    return path


def _splats(path: Path) -> Path:
    gaussian_ply.write(path, np.ones((5, 62)))
    return path


def _text(text: str) -> Callable[[Path], Path]:
    def make(path: Path) -> Path:
        path.write_text(text)
        return path

    return make


def _movie(path: Path) -> Path:
    path = path.with_suffix(".mp4")
    made_formats.write_movie(path, [np.full((64, 64, 3), 20 * i, np.uint8) for i in range(9)], rate=10)
    return path


def _read_movie(path: Path) -> None:
    recording = open_recording(path)
    for number in recording.index[:3]:
        recording.read_color(int(number))


def _format(write: Callable[[Path, object], Path]) -> Reader:
    return Reader(lambda path: write(path, walk(8, rate_hz=15.0)), _recording)


def _sidecar(path: Path) -> None:
    config.from_table(captures.Remarks, config.read_table(path), where=str(path))


CLICK = '{"recording": "a.r3d", "source_index": 3, "pixel": [0.5, 0.25]}'
READERS = {
    "record3d": Reader(lambda path: walk(8).write(path.with_suffix(".r3d")), _recording),
    "stray": _format(made_formats.stray),
    "polycam": _format(made_formats.polycam),
    "nerfcapture": _format(made_formats.nerfcapture),
    "tum": _format(made_formats.tum),
    "seven_scenes": _format(made_formats.seven_scenes),
    "video_and_depth": _format(made_formats.video_and_depth),
    "movie": Reader(_movie, _read_movie),
    "exr": Reader(_exr, images.read_depth),
    "npz": Reader(_npz, npz.load),
    "ply": Reader(_ply, ply.read_ply),
    "splats": Reader(_splats, gaussian_ply.read),
    "clicks": Reader(_text('{"pairs": [{"seen": ' + CLICK + ', "reference": ' + CLICK + "}]}"), clicks.read),
    "csv": Reader(_text("id,time,x,y,z,heading\n" + "".join(f"a,{i / 10},{i},0,1,0.5\n" for i in range(20))), tables.motion_from_csv),
    "toml": Reader(_text(
'role = "session"\nsplit = "train"\noffset_s = '
'1.5\nsynchronized_with = "b.r3d"\n'
), _sidecar),
    "depth_toml": Reader(_text("registered = false\ndepth_intrinsics = [26.5, 26.5, 12.0, 16.0]\ndelay_s = 0.1\n"), given.read),
}  # fmt: skip


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Return bytes with one to four mutations: flipped bits, deleted, duplicated or replaced ranges, hostile numbers."""
    data = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        if not data:
            break
        at = int(rng.integers(len(data)))
        span = int(min(len(data) - at, rng.integers(1, 33)))
        match rng.integers(6):
            case 0:
                data[at] ^= 1 << int(rng.integers(8))
            case 1:
                del data[at : len(data) if rng.random() < 0.3 else at + span]
            case 2:
                data[at:at] = data[at : at + span]
            case 3:
                data[at : at + span] = rng.bytes(span)
            case 4:
                data[at : at + 4] = int(rng.choice([0, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 16])).to_bytes(
                    4, "little"
                )
            case _:
                _replace_number(data, at, HOSTILE[rng.integers(len(HOSTILE))])
    return bytes(data)


def _replace_number(data: bytearray, at: int, hostile: bytes) -> None:
    """Replace the next number after ``at``, or insert at ``at``."""
    digits = b"0123456789.-+e"
    start = next((i for i in range(at, min(at + 200, len(data))) if data[i] in digits), at)
    end = start
    while end < len(data) and data[end] in digits:
        end += 1
    data[start:end] = hostile


def mutate_file(path: Path, rng: np.random.Generator) -> None:
    """Mutate a file in place: one file of a folder, or a member of an archive or the archive itself."""
    if path.is_dir():
        files = sorted(each for each in path.rglob("*") if each.is_file())
        texts = [each for each in files if each.suffix in (".txt", ".csv", ".json")]
        path = (
            files[rng.integers(len(files))]
            if rng.random() < 0.5 or not texts
            else texts[rng.integers(len(texts))]
        )
    elif path.suffix == ".r3d" and rng.random() < 0.7:
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        name = "metadata" if rng.random() < 0.6 else list(members)[rng.integers(len(members))]
        members[name] = mutated(members[name], rng)
        with zipfile.ZipFile(path, "w") as archive:
            for member, data in members.items():
                archive.writestr(member, data)
        return
    path.write_bytes(mutated(path.read_bytes(), rng))


def fuzz(name: str, inputs: int, until: float, seed: int) -> tuple[int, int]:
    """Run a reader on mutated inputs; return the numbers of inputs and failures."""
    reader, failed, number = READERS[name], 0, 0
    with tempfile.TemporaryDirectory() as temporary:
        valid = reader.make(Path(temporary, "good"))
        reader.read(valid)
        while number < inputs and time.monotonic() < until:
            mutated_file = Path(temporary, f"bad{valid.suffix}")
            shutil.copytree(valid, mutated_file) if valid.is_dir() else shutil.copy(valid, mutated_file)
            mutate_file(mutated_file, np.random.default_rng([seed, number, *name.encode()]))
            reason = _failure(reader, mutated_file)
            if reason is not None:
                failed += 1
                _save_failure(mutated_file, FAILURES / f"{name}-{seed}-{number}", reason)
            shutil.rmtree(mutated_file) if mutated_file.is_dir() else mutated_file.unlink()
            number += 1
    return number, failed


def _failure(reader: Reader, path: Path) -> str | None:
    """Return why a reader failed, or None if it gave a result or an `InputError` within the limits."""
    RESET.write_text("5")  # reset the peak memory
    signal.alarm(MAX_S)
    try:
        reader.read(path)
    except InputError:
        pass
    except Exception:
        return traceback.format_exc()
    finally:
        signal.alarm(0)
    peak_kb = int(re.search(r"VmHWM:\s+(\d+)", STATUS.read_text())[1])
    return f"{peak_kb} kB of memory" if peak_kb > MAX_KB else None


def _save_failure(path: Path, folder: Path, reason: str) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    shutil.copytree(path, folder / path.name) if path.is_dir() else shutil.copy(path, folder)
    (folder / "why.txt").write_text(reason)
    print(f"{folder}: {reason.strip().splitlines()[-1]}", flush=True)


def _time_out(*_: object) -> None:
    raise TimeoutError(f"longer than {MAX_S} s")


def main(arguments: list[str]) -> int:
    """Fuzz the named readers, or all of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("readers", nargs="*", choices=[[], *READERS], help="default: all")
    parser.add_argument("--inputs", type=int, default=200, help="inputs per reader")
    parser.add_argument("--seconds", type=float, default=60.0, help="time limit per reader")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGALRM, _time_out)
    total = 0
    for name in options.readers or READERS:
        count, failed = fuzz(name, options.inputs, time.monotonic() + options.seconds, options.seed)
        total += failed
        print(f"{name}: {count} inputs, {failed} failures", flush=True)
    return 1 if total else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
