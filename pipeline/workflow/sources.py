"""Content hash of a stage's code, from its syntax trees without importing anything.

`digest` changes if the code of a program or of a local module it imports changes, not with comments,
docstrings or layout; `config_of` imports the settings of a stage. Standard library only.
"""

import ast
import functools
import importlib
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pipeline.workflow import artifact


@dataclass(frozen=True)
class Source:
    """Digest and imports of one Python file."""

    digest: str
    imports: tuple[str, ...]
    """Dotted names of local modules that it may import."""


CODE = Path(__file__).parents[2]
"""Parent folder of `pipeline` and `stages`: the checkout, or the installed package."""
PLUMBING = (
    "core.errors",
    "core.config",
    "core.processes",
    "core.progress",
    "core.videos",
    "workflow.artifact",
    "workflow.cli",
    "workflow.dag",
)
"""Modules of `pipeline` that cannot affect what a stage computes."""
CACHE_VERSION = 5
"""Raise it to invalidate cached entries when parsing changes."""


@dataclass
class Cache:
    """Values read from files, by path, valid as long as size and times of the file are unchanged."""

    known: dict[str, Any] = field(default_factory=dict)
    fresh: dict[str, Any] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    """By stage, as computed by this process."""
    fingerprint: str = ""
    """Hash of names, sizes and times of all code, taken before any is read."""

    def get(self, path: Path, read: Any) -> Any:
        """Return `read(path)`, a value of plain JSON types, from the cache if the file is unchanged."""
        current = [CACHE_VERSION, *stat_fingerprint(path)]
        entry = self.fresh.get(str(path)) or self.known.get(str(path))
        if not isinstance(entry, dict) or entry.get("mark") != current:
            entry = {"mark": current, "value": read(path)}
        self.fresh[str(path)] = entry
        return entry["value"]


def digest(stage: str, cache: Cache) -> str:
    """Hash the program `stage`, the local modules below it, and its package's other files (pages)."""
    if stage in cache.digests:
        return cache.digests[stage]
    waiting, seen = [f"stages.{stage}.__main__"], {}
    while waiting:
        module = waiting.pop()
        path = _path_of(module)
        if module in seen or path is None or module.removeprefix("pipeline.") in PLUMBING:
            continue
        source = Source(**cache.get(path, _read))
        seen[module] = source.digest
        waiting += source.imports
    assets = _assets(Path("stages", stage.partition(".")[0]), cache)
    cache.digests[stage] = artifact.digest_of([seen, assets])
    return cache.digests[stage]


def stat_fingerprint(path: Path) -> list[int]:
    """Return size and times of a file."""
    stat = path.stat()
    return [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns]


def named_files(value: Any) -> dict[str, list[int]]:
    """Return size and modification time of every file that a recipe names, below folders too: checkpoints."""
    if isinstance(value, (dict, list)):
        parts = value.values() if isinstance(value, dict) else value
        return {path: mark for part in parts for path, mark in named_files(part).items()}
    files = _files_of(Path(value)) if isinstance(value, str) and os.path.exists(value) else []
    return {str(file): stat_fingerprint(file)[:2] for file in files}


def folder_fingerprint(folder: str, *, follow: bool = True) -> list[list[Any]]:
    """Return path, size and times of all files below `folder`; folder links are followed at the top only."""
    found: list[list[Any]] = []
    if not os.path.isdir(folder):
        return found
    for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
        if entry.name in ("__pycache__", "node_modules"):
            continue
        link = entry.is_symlink()
        if os.path.isdir(entry.path) if link and follow else entry.is_dir(follow_symlinks=False):
            found += folder_fingerprint(entry.path, follow=False)
        else:
            stat = entry.stat(follow_symlinks=not link or os.path.isfile(entry.path))
            found.append([entry.path, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns])
    return found


def is_stage(name: str) -> bool:
    """Return whether there is a stage program of this name, such as `segment_agent.identities`."""
    parts = name.split(".")
    return all(map(str.isidentifier, parts)) and CODE.joinpath("stages", *parts, "__main__.py").is_file()


def config_of(stage: str) -> type:
    """Return the `Config` of a stage, from `stages/<stage>/config.py`."""
    return importlib.import_module(f"stages.{stage}.config").Config


@functools.cache
def _path_of(module: str) -> Path | None:
    path = CODE.joinpath(*module.split("."))
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


def _assets(folder: Path, cache: Cache) -> dict[str, str]:
    """Return the digests of a stage folder's other files than Python, which it may read."""
    found = {}
    for path in sorted((CODE / folder).iterdir()) if (CODE / folder).is_dir() else ():
        if path.name.startswith((".", "__pycache__", "node_modules")) or path.suffix == ".py":
            continue
        if path.is_dir():
            found |= _assets(folder / path.name, cache)
        else:
            found[(folder / path.name).as_posix()] = cache.get(path, artifact.digest_of_file)
    return found


def recording_digest(path: Path, digest_of: Callable[[Path], str] = artifact.digest_of_file) -> str:
    """Return the hash of a recording: of the file, or of all files of a folder except hidden ones."""
    if path.is_file():
        return digest_of(path)
    return artifact.digest_of({f.relative_to(path).as_posix(): digest_of(f) for f in _files_of(path)})


def recording_size(path: Path) -> int:
    """Return the bytes of a recording's files; 0 if there is none."""
    return sum(file.stat().st_size for file in _files_of(path))


def _files_of(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted(file for file in path.rglob("[!.]*") if file.is_file())


def _read(path: Path) -> dict[str, Any]:
    try:
        tree = ast.parse(path.read_bytes(), str(path))
    except SyntaxError:  # fails when a stage imports it, without breaking the plan of the others
        return asdict(Source(artifact.digest_of_file(path), ()))
    imports = {
        name
        for node in ast.walk(tree)
        for name in _used(node, path)
        if name.startswith(("pipeline", "stages"))
    }
    for node in ast.walk(tree):
        _drop_docstrings(node)
    return asdict(Source(artifact.digest_of(ast.dump(tree)), tuple(sorted(imports))))


def _used(node: ast.AST, path: Path) -> list[str]:
    """Return modules that code at `path` may import (`from a import b`: `a`, `a.b`) or run (`"b.py"`)."""
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom) and node.module:
        names = [f"{node.module}.{alias.name}" for alias in node.names]
    elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.endswith(".py"):
        return [".".join(path.with_name(Path(node.value).stem).relative_to(CODE).parts)]
    else:
        return []
    return [".".join(name.split(".")[: i + 1]) for name in names for i in range(name.count(".") + 1)]


def _drop_docstrings(node: ast.AST) -> None:
    body = getattr(node, "body", None)
    if isinstance(body, list):
        statements = [n for n in body if not (isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant))]
        body[:] = statements or [ast.Pass()]
