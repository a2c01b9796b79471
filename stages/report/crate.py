"""The build as a research object (RO-Crate 1.1): recordings, settings, versions, contents, metrics, times.

`describe` writes what `make reproduce` reads; times come from the runner's records beside the artifacts.
"""

import json
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.core.videos import Video
from stages.report.collect import read_manifest

FILE = "ro-crate-metadata.json"
BUILTIN = "synthetic_capture"
"""Artifact of a build without a user's recordings."""
PLANNED = ("role", "split", "sha256", "synchronized_with", "offset_s", "animal")
"""Attributes of a recording needed to reproduce its plan."""
Entity = dict[str, Any]


def describe(
    name: str,
    folders: Mapping[str, Mapping[str | None, Path]],
    videos: Sequence[Video],
    metrics: Mapping[str, float | None],
    *,
    safe: bool = False,
    times: bool = True,
) -> Entity:
    """Return the content of `ro-crate-metadata.json`; `safe` leaves out names of files."""
    recordings = []
    for video in videos:
        named, planned = video.id if safe else video.file, {key: getattr(video, key) for key in PLANNED}
        recordings.append(_entity(f"#recording/{video.id}", "CreativeWork", named, planned))
    artifacts = list(_artifacts(folders, times))
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": f"Report of {name}",
        "hasPart": [{"@id": file} for file in ("index.html", "methods.md", "references.bib")],
        "mentions": [{"@id": entity["@id"]} for entity in (*recordings, *artifacts)],
        "variableMeasured": _properties(**dict(sorted(metrics.items()))),
    }
    if times:
        found = {"system": platform.system(), "architecture": platform.machine(), "cores": os.cpu_count()}
        root["locationCreated"] = {"@type": "Place", "additionalProperty": _properties(**found)}
    about = {
        "@id": FILE,
        "@type": "CreativeWork",
        "conformsTo": {"@id": "https://w3id.org/ro/crate/1.1"},
        "about": {"@id": "./"},
    }
    graph = [about, root, *recordings, *artifacts]
    return {"@context": "https://w3id.org/ro/crate/1.1/context", "@graph": graph}


def _artifacts(folders: Mapping[str, Mapping[str | None, Path]], times: bool) -> Iterator[Entity]:
    first = next(iter(folders["registration"].values()))
    for artifact, each in {BUILTIN: {None: first.with_name(BUILTIN)}, **folders}.items():
        for video, folder in each.items():
            manifest = read_manifest(folder)
            if manifest is not None:
                base = folder.parent if video is None else folder.parent.parent
                named = artifact if video is None else f"{artifact}.{video}"
                record = base / "records" / f"{named}.json"
                yield _artifact(named.replace(".", "/", 1), manifest, record, times)


def _artifact(name: str, manifest: Mapping[str, Any], record: Path, times: bool) -> Entity:
    properties = {key: manifest[key] for key in ("key", "content", "stage")}
    properties |= {key: json.dumps(manifest[key], sort_keys=True) for key in ("config", "versions", "inputs")}
    if times and record.exists():
        known = json.loads(record.read_bytes())
        keys = ("seconds", "cpu_seconds", "peak_memory_mb", "threads", "commit", "finished")
        properties |= {key: known.get(key) for key in keys}
    return _entity(f"#artifact/{name}", "Dataset", name, properties)


def _entity(at: str, kind: str, name: str, properties: Mapping[str, Any]) -> Entity:
    return {"@id": at, "@type": kind, "name": name, "additionalProperty": _properties(**properties)}


def _properties(**values: str | float | None) -> list[Entity]:
    return [{"@type": "PropertyValue", "name": name, "value": value} for name, value in values.items()]
