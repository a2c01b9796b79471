"""The methods section of a build, with BibTeX entries, from the settings in its manifests."""

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

from stages.report.collect import WORDS, read_manifest

Folders = Mapping[str, Mapping[str | None, Path]]
"""Folders of every artifact by recording; the key None if there is only one."""


@dataclass(frozen=True)
class Method:
    """One sentence about an artifact, which applies if its settings match `when`."""

    artifact: str
    sentence: str
    cites: tuple[str, ...] = ()
    when: Mapping[str, Any] = field(default_factory=dict)

    def holds(self, settings: Mapping[str, Any]) -> bool:
        """Return whether the sentence applies to the artifact; missing settings are ignored."""
        return all(settings.get(key, value) == value for key, value in self.when.items())


METHODS = tuple(Method(**entry | {"cites": tuple(entry.get("cites", ()))}) for entry in WORDS["methods"])
BIBLIOGRAPHY = resources.files("stages.report").joinpath("templates", "methods.bib").read_text("utf-8")
ENTRIES = {
    entry.split("{", 1)[1].split(",", 1)[0]: f"{entry.strip()}\n" for entry in BIBLIOGRAPHY.split("\n\n")
}
"""BibTeX entries by key."""


def paragraph(folders: Folders) -> str:
    """Return the methods of the build as one paragraph, citations as [key]."""
    return " ".join(
        method.sentence.removesuffix(".").format_map(settings)
        + (f" [{', '.join(method.cites)}]." if method.cites else ".")
        for method, settings in _used(folders)
    )


def document(folders: Folders) -> str:
    """Return the paragraph with software versions, as Markdown."""
    manifests = (read_manifest(folder) for each in folders.values() for folder in each.values())
    versions = sorted({f"{name} {v}" for m in manifests if m for name, v in m["versions"].items()})
    computed = f"\n\nComputed with {', '.join(versions)}." if versions else ""
    return f"# Methods\n\n{paragraph(folders)}{computed}\n"


def bibliography(folders: Folders) -> str:
    """Return the BibTeX entries of everything that the paragraph cites."""
    cited = sorted({key for method, _ in _used(folders) for key in method.cites})
    return "\n".join(ENTRIES[key] for key in cited)


def _used(folders: Folders) -> Iterator[tuple[Method, Mapping[str, Any]]]:
    """Yield the methods that apply, with their settings; those missing in older artifacts are NaN."""
    for method in METHODS:
        made = map(read_manifest, folders.get(method.artifact, {}).values())
        manifest = next(filter(None, made), None)
        if manifest is not None and method.holds(manifest["config"]):
            yield method, defaultdict(lambda: math.nan, manifest["config"])
