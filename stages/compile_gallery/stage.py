"""The stage: all finished builds -> one page that links to their simulators and reports."""

from pathlib import Path

import jinja2

from pipeline.core.errors import InputError
from pipeline.data import qa
from pipeline.metrics import words
from stages.compile_gallery import reading

_WORDS = {"ok": "all checks fine", "warn": "checks to look at", "fail": "checks failed", "none": "no checks"}


def run(root: Path) -> str:
    """Return the page for all builds in `root`, variants and animals of homes too. Raises ART-003 without."""
    folders = [
        folder
        for pattern in ("*", "*/animals/*", "*/variants/*")
        for folder in root.glob(pattern)
        if (folder / "simulator/manifest.json").is_file() and (folder / "simulator/index.html").is_file()
    ]
    if not folders:
        raise InputError("ART-003", "has no finished simulator", str(root), "build one: make cat")
    cards = [reading.card(folder, root) for folder in sorted(folders)]
    loader, undefined = jinja2.PackageLoader("stages.compile_gallery", "."), jinja2.StrictUndefined
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=undefined
    )
    environment.filters["number"] = words.number
    return environment.get_template("gallery.html").render(cards=cards, marks=qa.MARKS, words=_WORDS)
