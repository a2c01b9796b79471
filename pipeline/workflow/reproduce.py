"""Build again from a report's crate, and name what differs first. `make reproduce CRATE=path` calls both:

    python -SE -m pipeline.workflow.reproduce begin CRATE             recipe, recordings of `again_<hash>`
    python -SE -m pipeline.workflow.reproduce compare CRATE AGENT     exit 1 where something differs

Recordings are found by their hash among the captures here. Same seed, environment and kind of CPU: equal bit
for bit; elsewhere the metrics that moved are listed. Standard library only.
"""

import json
import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.core.errors import InputError, exit_code
from pipeline.workflow import artifact, dag
from pipeline.workflow.sources import recording_digest

FILE = "ro-crate-metadata.json"
SHOWN_METRICS = 20
"""Of those that moved, the ones that moved most."""


@dataclass(frozen=True)
class RecordedArtifact:
    """What a crate holds of one artifact."""

    name: str
    """`masks/v002`"""
    key: str | None
    content: str
    config: dict[str, Any]
    versions: dict[str, str]


@dataclass(frozen=True)
class Crate:
    """A build as its report describes it."""

    recordings: dict[str, str | None]
    """sha256 by file name; None for the built-in capture"""
    artifacts: tuple[RecordedArtifact, ...]
    metrics: dict[str, float | None]


def read(path: Path) -> Crate:
    """Read a crate, the file or its folder. Raises `InputError` CRT-001 for anything else."""
    file = path / FILE if path.is_dir() else path
    try:
        graph = json.loads(file.read_bytes())["@graph"]
        root = next(entity for entity in graph if entity["@id"] == "./")
        recordings, artifacts = {}, []
        for entity in graph:
            found = _properties(entity.get("additionalProperty", []))
            if entity["@id"].startswith("#recording/"):
                recordings[entity["name"]] = found["sha256"]
            elif entity["@id"].startswith("#artifact/"):
                settings, versions = json.loads(found["config"]), json.loads(found["versions"])
                artifacts.append(
                    RecordedArtifact(entity["name"], found["key"], found["content"], settings, versions)
                )
        return Crate(recordings, tuple(artifacts), _properties(root["variableMeasured"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, StopIteration) as error:
        remedy = f"give build/<agent>/report or its {FILE}"
        raise InputError("CRT-001", f"is no crate of a report ({error!r})", str(file), remedy) from error


def begin(crate: Crate, agents: Path, captures: Path) -> str:
    """Write the recipe, link the recordings, return the new animal's name. Raises CRT-002."""
    name = "again_" + artifact.digest_of([each.content for each in crate.artifacts])[:8]
    wanted = {file: _found(digest, captures) for file, digest in crate.recordings.items() if digest}
    found = {file: path for file, path in wanted.items() if path}
    missing = [file for file in wanted if file not in found]
    if missing:
        remedy = "put the recordings with these hashes into captures/<any agent>/"
        raise InputError("CRT-002", "recordings of the crate are not here", ", ".join(missing), remedy)
    (agents / f"{name}.toml").write_text(recipe(crate))
    (captures / name).mkdir(parents=True, exist_ok=True)
    for file, path in found.items():
        link = captures / name / file
        link.unlink(missing_ok=True)
        link.symlink_to(path.resolve())
    return name


def recipe(crate: Crate) -> str:
    """Return the settings of all artifacts as a recipe; the plan sets what differs between recordings."""
    tables: dict[str, dict[str, Any]] = {}
    for each in crate.artifacts:
        node = dag.NODES.get(each.name.partition("/")[0])
        if node is not None:
            settings = {key: value for key, value in each.config.items() if key not in node.fixed}
            table = tables.setdefault(dag.table_of(node), settings)
            for key in [key for key, value in table.items() if settings.get(key) != value]:
                del table[key]
    written = (_toml(table, [name]) for name, table in tables.items())
    return "# Written by `make reproduce`.\n" + "".join(written)


def differing(crate: Crate, build: Path) -> list[str]:
    """Return the names of artifacts whose content is not the crate's, or that are missing, in flow order."""
    order = {name: place for place, name in enumerate(dag.NODES)}
    wrong = []
    for each in crate.artifacts:
        made = artifact.read_manifest(build / each.name)
        if made is None or made.content != each.content:
            wrong.append(each.name)
    return sorted(wrong, key=lambda name: (order.get(name.partition("/")[0], len(order)), name))


def compare(crate: Crate, build: Path) -> Iterator[str]:
    """Yield what differs: the first artifact with its versions, then the metrics that moved most."""
    wrong = differing(crate, build)
    if not wrong:
        return
    yield f"{len(wrong)} of {len(crate.artifacts)} artifacts differ; the first one is {wrong[0]}"
    first = next(each for each in crate.artifacts if each.name == wrong[0])
    manifest = artifact.read_manifest(build / wrong[0])
    here = manifest.versions if manifest else {}
    for library in sorted(first.versions.keys() | here.keys()):
        if first.versions.get(library) != here.get(library):
            yield f"  {library}: {first.versions.get(library)} in the crate, {here.get(library)} here"
    try:
        now = json.loads((build / "evaluation/metrics.json").read_bytes())
    except (OSError, ValueError):
        return
    moved = {name: (old, now.get(name)) for name, old in crate.metrics.items() if old != now.get(name)}
    for name, (old, new) in sorted(moved.items(), key=lambda row: -_change(*row[1]))[:SHOWN_METRICS]:
        yield f"  {name}: {old} in the crate, {new} here"


def _change(old: float | None, new: float | None) -> float:
    if old is None or new is None:
        return math.inf
    return abs(new - old) / max(abs(old), 1e-9)


def _properties(rows: list[Mapping[str, Any]]) -> dict[str, Any]:
    return {row["name"]: row["value"] for row in rows}


def _found(digest: str, captures: Path) -> Path | None:
    for path in sorted(captures.glob("*/*")):
        if not path.is_symlink() and recording_digest(path) == digest:
            return path
    return None


def _toml(table: Mapping[str, Any], path: list[str]) -> str:
    """Write a table and those within it; what is None keeps its default."""
    inner = [_toml(value, [*path, key]) for key, value in table.items() if isinstance(value, Mapping)]
    plain = {key: value for key, value in table.items() if not isinstance(value, Mapping | None)}
    lines = [f"\n[{'.'.join(path)}]", *(f"{key} = {_value(value)}" for key, value in plain.items())]
    return "\n".join(lines) + "\n" + "".join(inner)


def _value(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_value(each) for each in value)}]"
    return json.dumps(value, ensure_ascii=False)


def main(arguments: list[str]) -> int:
    """Run one of the two commands of the module's docstring."""
    match arguments:
        case ["begin", path]:
            print(begin(read(Path(path)), Path("agents"), Path("captures")))
            return 0
        case ["compare", path, agent]:
            lines = list(compare(read(Path(path)), Path("build", agent)))
            print("\n".join(lines) or "every artifact is equal, bit for bit")
            return 1 if lines else 0
    print(__doc__, file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
