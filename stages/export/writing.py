"""What every export says about itself in `export.json`; and how optional libraries are met."""

import importlib
import importlib.metadata
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType

from pipeline.core.errors import InputError


@dataclass(frozen=True)
class ExportRecord:
    """What stands in `export.json`."""

    library: str
    """what wrote it, with its version"""
    loss_mm: dict[str, float]
    """distances between what is written and the reconstruction, by name; empty where nothing is lost"""
    opened_with: str
    """the tool that read it back while it was written"""
    remark: str = ""
    """what its reader has to know"""


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
