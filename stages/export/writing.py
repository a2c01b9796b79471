"""`export.json`, and imports of optional libraries."""

import importlib
import importlib.metadata
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType

from pipeline.core.errors import InputError


@dataclass(frozen=True)
class ExportRecord:
    """The contents of `export.json`."""

    library: str
    """library that wrote the files, with its version"""
    loss_mm: dict[str, float]
    """distances between the files and the reconstruction, by name; empty if lossless"""
    opened_with: str
    """tool that read the files back as a check"""
    remark: str = ""
    """units, axes and other notes for readers"""


def extra(module: str, package: str) -> ModuleType:
    """Import an optional library. Raises InputError EXP-010 naming the command that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        what = f"this format needs {package}: {error}"
        raise InputError("EXP-010", what, "the Python environment", "install it: make extras") from error


def version(package: str) -> str:
    """Name a library with its version."""
    return f"{package} {importlib.metadata.version(package)}"


def write_record(folder: Path, name: str, record: ExportRecord) -> None:
    """Write `export.json` beside the files."""
    found = (path for path in sorted(folder.rglob("*")) if path.is_file())
    files = {path.relative_to(folder).as_posix(): path.stat().st_size for path in found}
    pictures = [file for file in files if file.endswith((".jpg", ".png"))]
    listed = {file: size for file, size in files.items() if file not in pictures}
    table = {"format": name, **asdict(record), "files": listed, "pictures": len(pictures)}
    (folder / "export.json").write_text(json.dumps(table, indent=1) + "\n")
