"""The table of the benchmark: per row our result, results of other methods on the same data, and published results."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

HEADER = ("what", "data", "figures", "ours", "measured on the same data", "published", "bar", "met")


@dataclass(frozen=True)
class Row:
    """Results on one data set."""

    what: str
    data: str
    figures: str
    """names and units of the metrics, in the order of all cells"""
    ours: str
    measured: Mapping[str, str] = field(default_factory=dict)
    """other methods on the same data, by name"""
    published: Mapping[str, str] = field(default_factory=dict)
    """other methods, as published by their authors or later corrected"""
    bar: str = ""
    met: bool | None = None
    detail: Mapping[str, object] = field(default_factory=dict)
    """all values, for the JSON file"""

    def cells(self) -> tuple[str, ...]:
        """Return the cells of the row."""
        met = "-" if self.met is None else "yes" if self.met else "no"
        others = (_joined(self.measured), _joined(self.published))
        return (self.what, self.data, self.figures, self.ours, *others, self.bar, met)


def _joined(methods: Mapping[str, str]) -> str:
    return "; ".join(f"{name} {figures}" for name, figures in methods.items()) or "-"


def markdown(rows: Sequence[Row], skipped: Mapping[str, str], stamp: str) -> str:
    """Return the report: the table, skipped rows with reasons, and command, date and commit."""
    lines = [HEADER, ["---"] * len(HEADER), *(row.cells() for row in rows)]
    text = [f"| {' | '.join(line)} |" for line in lines]
    text += ["", *(f"- {name}: skipped. {why}" for name, why in skipped.items())]
    return "\n".join([*text, "", stamp, ""])


def write(folder: Path, rows: Sequence[Row], skipped: Mapping[str, str], stamp: str) -> str:
    """Write `table.md` and `table.json`; return the text."""
    folder.mkdir(parents=True, exist_ok=True)
    text = markdown(rows, skipped, stamp)
    content = {"rows": [asdict(row) for row in rows], "skipped": dict(skipped), "measured": stamp}
    (folder / "table.json").write_text(json.dumps(content, indent=1) + "\n")
    (folder / "table.md").write_text(text)
    return text
