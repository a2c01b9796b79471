"""What the code of a stage is, read from its syntax trees without importing anything.

`digest` changes when the meaning of a program or of a local module it imports can have changed, not with
comments, docstrings or layout; `config_of` imports the settings of a stage. Standard library only.
"""

import ast
import functools
import importlib
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from pipeline.workflow import artifact


@dataclass(frozen=True)
class Source:
    """One Python file, as far as the planner cares."""

    digest: str
    imports: tuple[str, ...]
    """Local modules that it may import, dotted."""


CODE = Path(__file__).parents[2]
"""What `pipeline` and `stages` stand in: the checkout, or where the package was installed."""
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
"""Files of `pipeline/` whose change cannot change what a stage computes."""
READER = 4
"""Raise it when more is read of a file, so that what was read before is read again."""


@dataclass
class Cache:
    """What was read before, by path, for as long as size and times of a file and its entry stay the same."""

    known: dict[str, Any] = field(default_factory=dict)
    fresh: dict[str, Any] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    """Of stages, as far as this process computed them."""
    marks: str = ""
    """Hash of name, size and times of all code, taken before any is read."""

    def get(self, path: Path, read: Any) -> Any:
        """Return `read(path)`, a value of plain JSON types, or what it was last time."""
        mark_now = [READER, *mark(path)]
        entry = self.fresh.get(str(path)) or self.known.get(str(path))
        if entry is None or entry["mark"] != mark_now:
            entry = {"mark": mark_now, "value": read(path)}
        self.fresh[str(path)] = entry
        return entry["value"]


def fits(known: Any) -> bool:
    """Return whether this is what a `Cache` kept."""
    entries = known.values() if isinstance(known, dict) else [None]
    values = [
        entry["value"] if isinstance(entry, dict) and entry.keys() == {"mark", "value"} else None
        for entry in entries
    ]
    names = {field.name for field in fields(Source)}
    return all(
        isinstance(value, str) or (isinstance(value, dict) and value.keys() == names) for value in values
    )


def digest(stage: str, cache: Cache) -> str:
    """Hash the program `stage`, the local modules below it, and its folder's other files (pages)."""
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
    cache.digests[stage] = artifact.digest_of([seen, _assets(Path("stages", *stage.split(".")), cache)])
    return cache.digests[stage]


def mark(path: Path) -> list[int]:
    """Return size and times of a file."""
    stat = path.stat()
    return [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns]


def marks(folder: str, *, follow: bool = True) -> list[list[Any]]:
    """Return path, size and times of all files below `folder`; in it, not below, links to folders count."""
    found: list[list[Any]] = []
    if not os.path.isdir(folder):
        return found
    for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
        if entry.name in ("__pycache__", "node_modules"):
            continue
        link = entry.is_symlink()
        if os.path.isdir(entry.path) if link and follow else entry.is_dir(follow_symlinks=False):
            found += marks(entry.path, follow=False)
        else:
            stat = entry.stat(follow_symlinks=not link or os.path.isfile(entry.path))
            found.append([entry.path, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns])
    return found


def config_of(stage: str) -> type:
    """Return the `Config` of a stage, from `stages/<stage>/config.py`."""
    return importlib.import_module(f"stages.{stage}.config").Config


@functools.cache
def _path_of(module: str) -> Path | None:
    path = CODE.joinpath(*module.split("."))
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


def _assets(room: Path, cache: Cache) -> dict[str, str]:
    """Return the digests of the room's files that are not Python and that the stage may read."""
    found = {}
    for path in sorted((CODE / room).iterdir()) if (CODE / room).is_dir() else ():
        if path.name.startswith((".", "__pycache__", "node_modules")) or path.suffix == ".py":
            continue
        if path.is_dir():
            found |= _assets(room / path.name, cache)
        else:
            found[(room / path.name).as_posix()] = cache.get(path, artifact.digest_of_file)
    return found


def recording_digest(path: Path, digest_of: Callable[[Path], str] = artifact.digest_of_file) -> str:
    """Return the hash of a recording: of the file, or of all files of a folder but hidden ones."""
    if path.is_file():
        return digest_of(path)
    files = sorted(file for file in path.rglob("[!.]*") if file.is_file())
    return artifact.digest_of({file.relative_to(path).as_posix(): digest_of(file) for file in files})


def _read(path: Path) -> dict[str, Any]:
    try:
        tree = ast.parse(path.read_bytes(), str(path))
    except SyntaxError:  # breaks the stages that import it, when they run; not the plan of all the others
        return asdict(Source(artifact.digest_of_file(path), ()))
    imports = {
        name for node in ast.walk(tree) for name in _imported(node) if name.startswith(("pipeline", "stages"))
    }
    for node in ast.walk(tree):
        _drop_docstrings(node)
    return asdict(Source(artifact.digest_of(ast.dump(tree)), tuple(sorted(imports))))


def _imported(node: ast.AST) -> list[str]:
    """Return the modules that a statement may import: `from a import b` imports `a`, and may mean `a.b`."""
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom) and node.module:
        names = [f"{node.module}.{alias.name}" for alias in node.names]
    else:
        return []
    return [".".join(name.split(".")[: i + 1]) for name in names for i in range(name.count(".") + 1)]


def _drop_docstrings(node: ast.AST) -> None:
    body = getattr(node, "body", None)
    if isinstance(body, list):
        statements = [n for n in body if not (isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant))]
        body[:] = statements or [ast.Pass()]
