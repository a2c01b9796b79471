"""What the code of a stage is, read from its syntax trees without importing anything.

`digest` changes when the meaning of a program or of a local module it imports can have changed, not with
comments, docstrings or layout; `settings` are the fields of its `Config`. Standard library only.
"""

import ast
import functools
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from pipeline import artifact, dag


@dataclass(frozen=True)
class Source:
    """One Python file, as far as the planner cares."""

    digest: str
    imports: tuple[str, ...]
    """Local modules that it may import, dotted."""
    settings: dict[str, dict[str, list[Any]]]
    """Per dataclass and field: its type as written, and its default, None where that is no literal."""
    bases: dict[str, list[str]]
    """Per dataclass: what it inherits from, as written."""


@dataclass(frozen=True)
class Setting:
    """One field of a dataclass of settings."""

    kind: str
    """Its type, as written."""
    default: Any
    """None where it is no literal."""
    module: str
    """Declares the field, and knows the names in `kind`."""


READER = 3
"""Raise it when more is read of a file, so that what was read before is read again."""


@dataclass
class Cache:
    """What was read before, by path, for as long as size and time of a file stay the same."""

    known: dict[str, Any] = field(default_factory=dict)
    fresh: dict[str, Any] = field(default_factory=dict)

    def get(self, path: Path, read: Any) -> Any:
        """Return `read(path)`, a value of plain JSON types, or what it was last time."""
        stat = path.stat()
        mark = [READER, stat.st_size, stat.st_mtime_ns]
        entry = self.fresh.get(str(path)) or self.known.get(str(path))
        if entry is None or entry["mark"] != mark:
            entry = {"mark": mark, "value": read(path)}
        self.fresh[str(path)] = entry
        return entry["value"]


def fits(known: Any) -> bool:
    """Tell whether this is what a `Cache` kept."""
    entries = known.values() if isinstance(known, dict) else [None]
    values = [entry["value"] if isinstance(entry, dict) and entry.keys() == {"mark", "value"} else None for entry in entries]
    names = {field.name for field in fields(Source)}
    return all(isinstance(value, str) or (isinstance(value, dict) and value.keys() == names) for value in values)


def digest(stage: str, cache: Cache) -> str:
    """Hash the program `stage`, the local modules below it, and the other files of its room (pages, templates)."""
    waiting, seen = [f"stages.{stage}.__main__"], {}
    while waiting:
        module = waiting.pop()
        path = _path_of(module)
        if module in seen or path is None or _is_plumbing(module):
            continue
        source = Source(**cache.get(path, _read))
        seen[module] = source.digest
        waiting += source.imports
    return artifact.digest_of([seen, _assets(Path("stages") / stage, cache)])


def settings(stage: str, cache: Cache) -> dict[str, Setting] | None:
    """Return the fields of the stage's `Config`, inherited ones included, or None if they cannot be told."""
    return _fields(f"stages.{stage}.__main__", "Config", cache)


def inner(setting: Setting, cache: Cache) -> dict[str, Setting] | None:
    """Return the fields of the dataclass that a setting is of, or None where it is of another type."""
    return _fields(setting.module, setting.kind, cache)


def _fields(module: str, name: str, cache: Cache) -> dict[str, Setting] | None:
    """Return the fields of the class `name` that a module defines or imports; `room.Options` is looked up in `room`."""
    path = _path_of(module)
    if path is None:
        return None
    source = Source(**cache.get(path, _read))
    if name in source.settings:
        inherited = [_fields(module, base, cache) or {} for base in source.bases[name]]
        own = {key: Setting(kind, default, module) for key, (kind, default) in source.settings[name].items()}
        return {key: setting for fields in (*inherited, own) for key, setting in fields.items()}
    home, _, name = name.rpartition(".")
    suffix = f".{home or name}"
    found = (_fields(other if home else other.removesuffix(suffix), name, cache) for other in source.imports if other.endswith(suffix))
    return next((fields for fields in found if fields is not None), None)


@functools.cache
def _path_of(module: str) -> Path | None:
    path = Path(*module.split("."))
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


def _is_plumbing(module: str) -> bool:
    return module.removeprefix("pipeline.") in dag.PLUMBING


def _assets(room: Path, cache: Cache) -> dict[str, str]:
    """Return the digests of the room's files that are not Python and that the stage may read."""
    found = {}
    for path in sorted(room.iterdir()) if room.is_dir() else ():
        if path.name.startswith((".", "__pycache__", "node_modules")) or path.suffix == ".py":
            continue
        if path.is_dir():
            found |= _assets(path, cache)
        else:
            found[path.as_posix()] = cache.get(path, artifact.digest_of_file)
    return found


def _read(path: Path) -> dict[str, Any]:
    try:
        tree = ast.parse(path.read_bytes(), str(path))
    except SyntaxError:  # breaks the stages that import it, when they run; not the plan of all the others
        return asdict(Source(artifact.digest_of_file(path), (), {}, {}))
    imports = {name for node in ast.walk(tree) for name in _imported(node) if name.startswith(("pipeline", "stages"))}
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    bases = {cls.name: [ast.unparse(base) for base in cls.bases] for cls in classes}
    fields = {cls.name: dict(_field(node) for node in cls.body if isinstance(node, ast.AnnAssign)) for cls in classes}
    for node in ast.walk(tree):
        _drop_docstrings(node)
    return asdict(Source(artifact.digest_of(ast.dump(tree)), tuple(sorted(imports)), fields, bases))


def _imported(node: ast.AST) -> list[str]:
    """Return the modules that a statement may import; `from a import b` may mean `a.b`, and imports package `a`."""
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
        kept = [n for n in body if not (isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant))]
        node.body = kept or [ast.Pass()]


def _field(node: ast.AnnAssign) -> tuple[str, list[Any]]:
    try:
        default = None if node.value is None else ast.literal_eval(node.value)
    except ValueError:
        default = None
    return ast.unparse(node.target), [ast.unparse(node.annotation), default]
