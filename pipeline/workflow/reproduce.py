"""Rebuild from a report's crate and name the first difference. `make reproduce CRATE=path` calls both:

    python -SE -m pipeline.workflow.reproduce begin CRATE             recipe, recordings of `again_<hash>`
    python -SE -m pipeline.workflow.reproduce compare CRATE AGENT     exit 1 where something differs

Recordings are found by hash in the local captures; clicks, prompts and a former reconstruction beside them.
With the same code, environment and CPU results are bit-identical; else changed metrics are listed. Standard
library only.
"""

import glob
import json
import math
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.core import config
from pipeline.core.errors import InputError, exit_code
from pipeline.core.videos import Video
from pipeline.workflow import artifact, captures, dag, recipes
from pipeline.workflow.sources import recording_digest

FILE = "ro-crate-metadata.json"
SHOWN_METRICS = 20
"""Number of changed metrics to list, the most changed ones."""


@dataclass(frozen=True)
class Crate:
    """A build as its report describes it."""

    recordings: tuple[Video, ...]
    """`sha256` is None for the built-in capture"""
    artifacts: dict[str, artifact.Manifest]
    """by name such as `masks/v002`, in flow order; without their files"""
    metrics: dict[str, float | None]


def read(path: Path) -> Crate:
    """Read a crate, the file or its folder. Raises `InputError` CRT-001 for anything else."""
    file = path / FILE if path.is_dir() else path
    try:
        graph = json.loads(file.read_bytes())["@graph"]
        root = next(entity for entity in graph if entity["@id"] == "./")
        recordings, artifacts = [], {}
        for entity in graph:
            found = _properties(entity.get("additionalProperty", []))
            if recording := re.fullmatch(r"#recording/(v\d+)", entity["@id"]):
                video = {"id": recording[1], "file": entity["name"], **found}
                recordings.append(config.from_table(Video, video, where=str(file)))
            elif entity["@id"].startswith("#artifact/"):
                tables = {key: json.loads(found[key]) for key in ("inputs", "config", "versions")}
                known = {key: found[key] for key in ("stage", "key", "content")} | tables
                artifacts[entity["name"]] = artifact.Manifest(**known, files={})
        return Crate(tuple(recordings), artifacts, _properties(root["variableMeasured"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, StopIteration) as error:
        remedy = f"give build/<agent>/report or its {FILE}"
        raise InputError("CRT-001", f"is no crate of a report ({error!r})", str(file), remedy) from error


def begin(crate: Crate, agents: Path, captured: Path, builds: Path) -> str:
    """Write the recipe, link the recordings, return the new animal's name. Raises CRT-002, CRT-003."""
    name = "again_" + artifact.digest_of([each.content for each in crate.artifacts.values()])[:8]
    if any(video.animal for video in crate.recordings):
        what, remedy = "is of one of several animals; the others' turnarounds are not in it", "build the home"
        raise InputError("CRT-003", what, name, remedy)
    wanted = {video: video.sha256 for video in crate.recordings if video.sha256}
    paths = [path for path in captured.glob("*/*") if wanted and not path.is_symlink()]
    known = {recording_digest(path): path for path in paths}
    if missing := [video.file for video, digest in wanted.items() if digest not in known]:
        remedy = "put the recordings with these hashes into captures/<any agent>/"
        raise InputError("CRT-002", "recordings of the crate are not here", ", ".join(missing), remedy)
    # A crate is untrusted and may hide names: build paths from ids instead.
    files = {video.id: f"{video.id}{known[digest].suffix}" for video, digest in wanted.items()}
    said = {}
    for video, digest in wanted.items():
        path, file = known[digest], files[video.id]
        _link(path, file, captured / name)
        other = files.get(video.synchronized_with or "")
        clock = {"synchronized_with": other, "offset_s": video.offset_s if other else None}
        said[f'"{file}"'] = {"role": video.role, "split": video.split, **clock}
    (agents / f"{name}.toml").write_text(recipe(crate) + _toml(said, [recipes.VIDEOS_TABLE]))
    ids = json.dumps({file: id for id, file in files.items()})
    artifact.write_if_changed(builds / name / "plan/ids.json", ids)
    return name


def _link(path: Path, file: str, links: Path) -> None:
    """Link a recording under the name `file`, and the files beside it that affect results."""
    wanted = {extra: path.with_name(extra) for node in dag.FLOW for extra in node.extra_inputs} | {file: path}
    for sidecar in path.parent.glob(f"{glob.escape(path.name)}.*{captures.SIDECAR}"):
        wanted[file + sidecar.name.removeprefix(path.name)] = sidecar
    links.mkdir(parents=True, exist_ok=True)
    for link, source in wanted.items():
        (links / link).unlink(missing_ok=True)
        if source.exists():
            (links / link).symlink_to(source.resolve())


def recipe(crate: Crate) -> str:
    """Return the settings of all artifacts as a recipe, without those that the plan sets per recording."""
    tables: dict[str, dict[str, Any]] = {}
    for name, each in crate.artifacts.items():
        node = dag.NODES.get(name.partition("/")[0])
        if node is not None:
            settings = {key: value for key, value in each.config.items() if key not in node.fixed}
            table = tables.setdefault(dag.table_of(node), settings)
            for key in [key for key, value in table.items() if settings.get(key) != value]:
                del table[key]
    written = (_toml(table, [name]) for name, table in tables.items())
    return "# Written by `make reproduce`.\n" + "".join(written)


def differing(crate: Crate, build: Path) -> list[str]:
    """Return the names of artifacts that are missing or differ from the crate's, in flow order."""
    contents = {name: artifact.digest_of(artifact.digests(build / name)) for name in crate.artifacts}
    return [name for name, each in crate.artifacts.items() if each.content != contents[name]]


def compare(crate: Crate, build: Path) -> Iterator[str]:
    """Yield the differences: the first artifact, its versions and settings, then the most changed metrics."""
    wrong = differing(crate, build)
    if not wrong:
        return
    yield f"{len(wrong)} of {len(crate.artifacts)} artifacts differ; the first one is {wrong[0]}"
    first, here = crate.artifacts[wrong[0]], artifact.read_manifest(build / wrong[0])
    if here is None:
        return
    if changed := artifact.damaged(build / wrong[0]):
        yield f"  changed since it was written: {', '.join(changed)}"
    for was, now in ((first.versions, here.versions), (first.config, here.config)):
        for name in sorted(name for name in was.keys() | now.keys() if was.get(name) != now.get(name)):
            yield f"  {name}: {was.get(name)} in the crate, {now.get(name)} here"
    now = artifact.read_json(build / "evaluation/metrics.json")
    if not now:
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


def _toml(table: Mapping[str, Any], path: list[str]) -> str:
    """Return a table and its nested tables as TOML; None keeps the default."""
    inner = [_toml(value, [*path, key]) for key, value in table.items() if isinstance(value, Mapping)]
    plain = {key: value for key, value in table.items() if not isinstance(value, Mapping | None)}
    lines = [
        f"\n[{'.'.join(path)}]",
        *(f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in plain.items()),
    ]
    return "\n".join(lines) + "\n" + "".join(inner)


def main(arguments: list[str]) -> int:
    """Run one of the two commands of the module's docstring."""
    match arguments:
        case ["begin", path]:
            print(begin(read(Path(path)), Path("agents"), Path("captures"), Path("build")))
            return 0
        case ["compare", path, agent]:
            lines = list(compare(read(Path(path)), Path("build", agent)))
            print("\n".join(lines) or "every artifact is equal, bit for bit")
            return 1 if lines else 0
    print(__doc__, file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
