"""Artifacts: folders that exist whole or not at all.

`create` yields a hidden temporary folder beside the final one; when the block ends well it writes
`manifest.json` (sha256 of every file), syncs the disk and renames. `opened` and `read_manifest` read a
finished one. What varies between runs (seconds, host, commit) is kept in a record, never in an artifact.
Standard library only: the planner and the runner use this file too.
"""

import contextlib
import ctypes
import fcntl
import hashlib
import json
import os
import shutil
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pipeline.core.config import from_table
from pipeline.core.errors import MAKE_AGAIN, InputError
from pipeline.workflow import dag

MANIFEST = "manifest.json"
STAMP = ".ok"
"""Stamp file that the runner writes once an artifact is up to date; Make compares its age."""
_VERSIONS = ("numpy", "scipy", "torch", "opencv-contrib-python-headless", "pycolmap", "onnxruntime")


@dataclass(frozen=True)
class Manifest:
    """What an artifact is and what it was made from."""

    stage: str
    """Program that wrote it."""
    key: str | None
    """Cache key: hash of everything that determines its content; None if a stage was run by hand."""
    content: str
    """Hash of the names and bytes of its files."""
    inputs: dict[str, str]
    """`content` of every artifact that was read, by name."""
    config: dict
    """The stage's full configuration, defaults included."""
    versions: dict[str, str]
    """Versions of Python and of the libraries that affect numerical results."""
    files: dict[str, str]
    """sha256 per file, by path inside the folder."""
    version: int = 1
    """File format version of its stage, see `dag.Node.version`."""


def read_manifest(folder: Path) -> Manifest | None:
    """Return the manifest of `folder`, or None if there is no finished artifact."""
    path = folder / MANIFEST
    try:
        return from_table(Manifest, dict(json.loads(path.read_bytes())), where=str(path))
    except (FileNotFoundError, NotADirectoryError, ValueError, TypeError, RecursionError, InputError):
        return None


def opened(folder: Path, name: str) -> Manifest:
    """Return the manifest of the finished artifact at `folder`. Raises ART-001, ART-007 (other version)."""
    manifest = read_manifest(folder)
    if manifest is None:
        what = f"{name} is missing or unfinished"
        raise InputError("ART-001", what, str(folder), "build it first: make <agent>.<artifact>")
    _refuse_other_version(manifest, folder)
    return manifest


def version_of(stage: str) -> int:
    """Return the current file format version of a stage."""
    return max((node.version for node in dag.FLOW if node.stage.rpartition(".")[2] == stage), default=1)


def _refuse_other_version(made: Manifest, folder: Path) -> None:
    if made.version != version_of(made.stage):
        what = f"{made.stage} wrote it in version {made.version}; this is version {version_of(made.stage)}"
        raise InputError("ART-007", what, str(folder), MAKE_AGAIN)


def require(build: Path, *names: str, remedy: str) -> None:
    """Raise ART-003 with ``remedy`` if a build lacks an artifact, ART-007 for one of another version."""
    for name in names:
        if not (build / name).is_dir():
            raise InputError("ART-003", f"has no {name}", str(build), remedy)
        if made := read_manifest(build / name):
            _refuse_other_version(made, build / name)


@contextlib.contextmanager
def create(
    out: Path, *, stage: str, config: Mapping[str, Any], inputs: Mapping[str, str], key: str | None = None
) -> Iterator[Path]:
    """Yield a folder to fill; it replaces the artifact at `out` if, and only if, the block ends well."""
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.tmp.{os.getpid()}")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    try:
        yield temporary
        files = digests(temporary)
        if not files:
            remedy = "this is a fault of the stage: report it"
            raise InputError("ART-002", f"{stage} wrote nothing", str(out), remedy)
        content, ordered = digest_of(files), dict(sorted(inputs.items()))
        manifest = Manifest(stage, key, content, ordered, dict(config), versions(), files, version_of(stage))
        (temporary / MANIFEST).write_text(json.dumps(asdict(manifest), indent=1, sort_keys=True) + "\n")
        sync_disk(temporary)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    old = out.with_name(f".{out.name}.old.{os.getpid()}")
    if out.exists():  # a reader sees the old artifact, none, or the new one, never a mixture
        out.rename(old)
    temporary.rename(out)
    _sync_folder(out.parent)
    shutil.rmtree(old, ignore_errors=True)


def digests(folder: Path) -> dict[str, str]:
    """Return the sha256 of every file under `folder` by relative path, except manifest and stamp."""
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return {name: digest_of_file(folder / name) for name in names if name not in (MANIFEST, STAMP)}


def damaged(folder: Path) -> list[str]:
    """Return the files of the finished artifact at `folder` that are missing or fail their checksum."""
    manifest, found = read_manifest(folder), digests(folder)
    return [name for name, digest in manifest.files.items() if found.get(name) != digest] if manifest else []


def digest_of_file(path: Path) -> str:
    """Return the sha256 of one file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_json(path: Path) -> dict[str, Any]:
    """Return the table in a JSON file that can be made again; empty if it is missing or damaged."""
    try:
        return dict(json.loads(path.read_bytes()))
    except (FileNotFoundError, ValueError, TypeError, RecursionError):
        return {}


def digest_of(value: Any) -> str:
    """Hash a value made of plain JSON types."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def clean(*outs: Path) -> None:
    """Remove temporary files left by killed writers of these paths; the caller holds the lock."""
    for out in outs:
        for leftover in (*out.parent.glob(f".{out.name}.tmp*"), *out.parent.glob(f".{out.name}.old.*")):
            if leftover.is_dir():
                shutil.rmtree(leftover, ignore_errors=True)
            else:
                leftover.unlink(missing_ok=True)


@contextlib.contextmanager
def locked(lock: Path, waiting: str = "") -> Iterator[None]:
    """Hold an exclusive `flock`, released when the process dies. If taken, print `waiting` and block."""
    lock.parent.mkdir(parents=True, exist_ok=True)
    with lock.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if waiting:
                print(waiting, file=sys.stderr, flush=True)
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def versions() -> dict[str, str]:
    """Return the versions of Python and of the installed libraries that affect numerical results."""
    import importlib.metadata  # imported late: the planner does not need it

    found = {"python": ".".join(map(str, sys.version_info[:3]))}
    for name in _VERSIONS:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def write_if_changed(path: Path, text: str, *, sync: bool = True) -> bool:
    """Replace a small file atomically; keep it and its modification time if the content is the same.

    Writers of the same file hold a lock, so the next one overwrites the leftovers of one that was killed.
    Without `sync` the caller flushes the disk itself (`sync_disk`) before anything relies on the file.
    """
    data = text.encode()
    with contextlib.suppress(FileNotFoundError):
        if path.read_bytes() == data:
            return False
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    with temporary.open("wb") as file:
        file.write(data)
        if sync:
            file.flush()
            os.fsync(file.fileno())
    temporary.replace(path)
    return True


def sync_disk(path: Path) -> None:
    """Flush the file system that holds `path`: one call instead of one per file."""
    handle = os.open(path, os.O_RDONLY)
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if hasattr(libc, "syncfs"):
            if libc.syncfs(handle) != 0:
                raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(path))
        else:
            os.sync()
    finally:
        os.close(handle)


def _sync_folder(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
