"""`data_layout.md` agrees with what the stages write: artifacts, files, and keys, axes and dtypes of arrays."""

import importlib
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pipeline.data.schema import FileSchema
from pipeline.workflow import dag

ROOT = Path(__file__).parent.parent
OF_EVERY_ARTIFACT = re.compile(r"manifest\.json|\.ok|qa\.json|qa/.*")
KEY = re.compile(r"`(\w+) \[([^\]]*)\] (f2|f4|f8|u1|u2|i4|i8|bool|U)`( \(absent)?")
OPTIONAL = ("absent when", "only where", "held-out phone only", "sessions:")


@dataclass(frozen=True)
class Row:
    """One row of an artifact's table."""

    patterns: tuple[re.Pattern[str], ...]
    """Patterns of paths inside the artifact."""
    text: str
    """Description of the files."""
    files: str
    """File names as written."""

    @property
    def arrays(self) -> list[tuple[str, int, str, bool]]:
        """Name, number of axes, dtype and whether it may be absent, of every documented array."""
        if "packed" in self.text:
            return []
        absent_without_animal = "has no animal" in self.text
        return [
            (name, len(axes.split()), dtype, bool(absent) or absent_without_animal)
            for name, axes, dtype, absent in KEY.findall(self.text)
        ]


def pattern_of(text: str) -> re.Pattern[str]:
    text = re.escape(text).replace(r"%06d", r"\d{6}").replace("%06d", r"\d{6}")
    text = re.sub(r"<\w+>", "[^/.]+", text.replace(r"\<", "<").replace(r"\>", ">"))
    text = re.sub(r"\\\{(\w+),(\w+)\\\}", r"(\1|\2)", text).replace(r"\*", "[^/]*")
    return re.compile(text + ".*" if text.endswith("/") else text)


@cache
def documented_rows() -> dict[str, list[Row]]:
    """Return the rows per artifact, in the order of the page."""
    found: dict[str, list[Row]] = {}
    for section in (ROOT / "data_layout.md").read_text().split("\n### ")[1:]:
        heading, *lines = section.splitlines()
        names = re.findall(r"`(\w+)/(?:<id>/)?`", heading)
        found |= {name: [] for name in names}
        cells = [line.strip("|").split(" | ", 1) for line in lines if line.startswith("| `")]
        if not cells:  # the file is described by the heading
            cells = [[heading.split(" — ", 1)[1].split(":", 1)[1], heading]]
        for files, text in cells:
            for name in names:
                names_in_row = [t for t in re.findall(r"`([^`]+)`", files) if "." in t or t.endswith("/")]
                several = dag.NODES[name].roles or dag.NODES[name].trials == "each"
                own = [t for t in names_in_row if not (t.split("/")[0] in names and t.split("/")[0] != name)]
                mine = [t.removeprefix(f"{name}/").removeprefix("<id>/" if several else "") for t in own]
                if mine:
                    found[name].append(Row(tuple(map(pattern_of, mine)), text, files))
    return found


def test_every_artifact_is_documented():
    assert list(documented_rows()) == sorted(dag.NODES, key=list(documented_rows()).index)
    text = (ROOT / "data_layout.md").read_text()
    assert [node.stage for node in dag.FLOW if f"`{node.stage}`" not in text] == []


SCHEMAS = [
    value
    for module in sorted(Path(ROOT, "pipeline", "data").glob("*.py"))
    for value in vars(importlib.import_module(f"pipeline.data.{module.stem}")).values()
    if isinstance(value, FileSchema)
]


@pytest.mark.parametrize("schema", {each.file: each for each in SCHEMAS}.values(), ids=lambda each: each.file)
def test_schemas_agree_with_the_page(schema):
    """Schemas of `pipeline.data` have the documented keys, axes and dtypes."""
    artifact, name = schema.file.split("/")
    (row,) = [row for row in documented_rows()[artifact] if f"{name}`" in row.files]
    documented = {key: (axes, dtype) for key, axes, dtype, _ in KEY.findall(row.text)}
    assert documented == {key: (" ".join(each.axes), each.dtype) for key, each in schema.arrays.items()}


def folders(build: Path, name: str) -> list[Path]:
    folder = build / name
    return sorted(folder.iterdir()) if dag.NODES[name].roles else [folder]


def files(folder: Path) -> list[str]:
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return [name for name in names if not OF_EVERY_ARTIFACT.fullmatch(name)]


@pytest.mark.toy
@pytest.mark.parametrize(
    "name", [node.artifact for node in dag.nodes_of("recordings") if not (node.on_demand or node.mapped)]
)
def test_files_are_as_documented(toy, name):
    written = {file for folder in folders(toy, name) for file in files(folder)}
    patterns = [pattern for row in documented_rows()[name] for pattern in row.patterns]
    assert [file for file in sorted(written) if not any(p.fullmatch(file) for p in patterns)] == [], (
        "written, not documented"
    )
    needed = [
        p
        for row in documented_rows()[name]
        for p in row.patterns
        if not any(word in row.text for word in OPTIONAL)
    ]
    assert [p.pattern for p in needed if not any(map(p.fullmatch, written))] == [], "documented, not written"


@pytest.mark.toy
@pytest.mark.parametrize(
    "name", [node.artifact for node in dag.nodes_of("recordings") if not (node.on_demand or node.mapped)]
)
def test_arrays_are_as_documented(toy, name):
    for row in documented_rows()[name]:
        for folder in folders(toy, name):
            for file in files(folder):
                if file.endswith(".npz") and any(pattern.fullmatch(file) for pattern in row.patterns):
                    check_arrays(folder / file, row)


@pytest.mark.toy
def test_files_beside_the_artifacts_are_documented(toy):
    section = (ROOT / "data_layout.md").read_text().split("Beside the artifacts")[1].split("\n\n")[1]
    cells = [row.strip("|").split(" | ")[0] for row in section.splitlines()]
    documented = {name.split("/")[0] for cell in cells for name in re.findall(r"`([^`]+)`", cell)}
    assert {path.name for path in toy.iterdir()} - {*dag.NODES, "variants", "tables"} <= documented


def check_arrays(path: Path, row: Row) -> None:
    with np.load(path, allow_pickle=False) as arrays:
        for name, axes, dtype, may_be_absent in row.arrays:
            found = [key for key in arrays.files if key == name or key.endswith(f"/{name}")]
            assert found or may_be_absent, f"{path}: no {name}"
            for key in found:
                array = arrays[key]
                assert array.ndim == axes, f"{path}: {key} has {array.ndim} axes, documented {axes}"
                fits = array.dtype.kind == "U" if dtype == "U" else array.dtype == np.dtype(dtype)
                assert fits, f"{path}: {key} is {array.dtype}, documented {dtype}"
