"""The stage: all finished builds -> one page that links to their simulators and reports."""

import base64
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jinja2
from PIL import Image

from pipeline.core.errors import InputError
from pipeline.data import qa
from pipeline.metrics import bars, words
from pipeline.metrics.metrics import Metrics

_WORDS = {"ok": "all checks fine", "warn": "checks to look at", "fail": "checks failed", "none": "no checks"}
PICTURES = ("*simulator/qa/visits*.webp", "simulator/qa/heat_maps.webp", "splats/qa/frames.webp")
"""Candidate pictures for a build's card, the best first; all of them are in its report."""
_SIMULATORS = {"simulator": "walk with it", "home_simulator": "walk with them"}
"""Pages of one animal and of a home of several, and what their links say."""
METRICS = (
    "behavior/ats/goal_minde_m",
    "reconstruction/agent_root_m_median",
    "registration/translation_m_median",
)
"""Keys of `metrics.json` that are easy to interpret."""
_CHECKS = ("sessions to replay", "size of the page")
"""Names of the simulator's own checks that are shown."""
_QUALITY = 82
_THUMBNAIL_PX = 480
"""Longer side; twice the width of a card."""


@dataclass(frozen=True)
class Figure:
    """A number with its label."""

    words: str
    value: float
    unit: str


@dataclass(frozen=True)
class Link:
    """A page beside the gallery."""

    words: str
    address: str
    """relative to the gallery"""


@dataclass(frozen=True)
class Card:
    """One animal, or a home of several."""

    name: str
    folder: str
    thumbnail: str | None
    """WebP as a data address"""
    status: qa.Status | Literal["none"]
    """worst of its artifacts' checks and of the report's thresholds; "none" without any check"""
    figures: tuple[Figure, ...]
    links: tuple[Link, ...]
    """the first one to its simulator"""
    home: bool


def run(root: Path) -> str:
    """Return the page for all builds in `root`: animals, homes, variants. Raises ART-003 without any."""
    folders = [
        folder
        for pattern in ("*", "*/animals/*", "*/variants/*")
        for folder in root.glob(pattern)
        if _simulator(folder)
    ]
    if not folders:
        raise InputError("ART-003", "has no finished simulator", str(root), "build one: make cat")
    cards = [card(folder, root) for folder in sorted(folders)]
    loader, undefined = jinja2.PackageLoader("stages.compile_gallery", "."), jinja2.StrictUndefined
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=undefined
    )
    environment.filters["number"] = words.number
    return environment.get_template("gallery.html").render(cards=cards, marks=qa.MARKS, words=_WORDS)


def card(folder: Path, root: Path) -> Card:
    """Read the build in `folder`, whose simulator is finished, for a gallery in `root`."""
    simulator = _simulator(folder)
    contract = json.loads((folder / simulator / "simulator.json").read_bytes())
    files = [*folder.glob("*/qa.json"), *folder.glob("*/*/qa.json")]
    states = [check["status"] for file in files for check in json.loads(file.read_bytes())["checks"]]
    evaluation = folder / "evaluation"
    metrics = Metrics.read(evaluation) if (evaluation / "metrics.json").is_file() else Metrics()
    states += [bars.worst(bars.judge(metrics.values, metrics.reasons))] if states else []
    pictures = [file for name in PICTURES for file in sorted(folder.glob(name))]
    pages = [(_SIMULATORS[simulator], folder / simulator / "index.html")]
    pages.append(("report", folder / "report/index.html"))
    homes = sorted(folder.glob("homes/*/*simulator/index.html"))
    pages += [(f"in the home of {home.parents[1].name}", home) for home in homes]
    checks = json.loads((folder / simulator / "qa.json").read_bytes())["checks"]
    figures = [Figure(one["name"], one["value"], one["unit"]) for one in checks if one["name"] in _CHECKS]
    known = ((key, metrics.values.get(key)) for key in METRICS)
    measured = [(words.describe(key), value) for key, value in known if value is not None]
    figures += [Figure(found.text, value, found.unit) for found, value in measured]
    return Card(
        name=folder.name if folder.parent.name == "animals" else str(contract["name"]),
        folder=folder.relative_to(root).as_posix(),
        thumbnail=_thumbnail(pictures[0]) if pictures else None,
        status=qa.worst(states) if states else "none",
        figures=tuple(figures),
        links=tuple(Link(to, page.relative_to(root).as_posix()) for to, page in pages if page.is_file()),
        home=simulator == "home_simulator",
    )


def _simulator(folder: Path) -> str:
    """Return which finished simulator a folder has; empty where none."""
    return next((name for name in _SIMULATORS if (folder / name / "manifest.json").is_file()), "")


def _thumbnail(file: Path) -> str:
    with Image.open(file) as picture:
        small = picture.convert("RGB")
        small.thumbnail((_THUMBNAIL_PX, _THUMBNAIL_PX))
        buffer = io.BytesIO()
        small.save(buffer, "WEBP", quality=_QUALITY)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"
