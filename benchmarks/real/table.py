"""The table that the benchmark prints: one line per row, ours beside peers that were measured on the same data
and peers that others published.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

HEADER = ("what", "data", "figures", "ours", "measured on the same data", "published", "bar", "met")


@dataclass(frozen=True)
class Row:
    """What was measured on one kind of data."""

    what: str
    data: str
    figures: str
    """names and units of the figures, in the order in which all cells give them"""
    ours: str
    measured: Mapping[str, str] = field(default_factory=dict)
    """of other methods on the same data, by their names"""
    published: Mapping[str, str] = field(default_factory=dict)
    """of other methods, as their authors or later corrections state them"""
    bar: str = ""
    met: bool | None = None
    detail: Mapping[str, object] = field(default_factory=dict)
    """all numbers, for the JSON file"""

    def cells(self) -> tuple[str, ...]:
        """Return the row's line."""
        met = "-" if self.met is None else "yes" if self.met else "no"
        others = (_listed(self.measured), _listed(self.published))
        return (self.what, self.data, self.figures, self.ours, *others, self.bar, met)


def _listed(methods: Mapping[str, str]) -> str:
    return "; ".join(f"{name} {figures}" for name, figures in methods.items()) or "-"


def markdown(rows: Sequence[Row], skipped: Mapping[str, str], stamp: str) -> str:
    """Return the whole report: the table, what was skipped and why, and the command, date and commit."""
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
