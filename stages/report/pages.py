"""Turn chapters and metrics into pages: one index and one page per chapter, each a file of its own."""

from collections.abc import Mapping, Sequence
from typing import Any

import jinja2

from pipeline.data import qa
from pipeline.metrics import words as metric_words
from pipeline.metrics.bars import Judged
from stages.report.collect import ChapterReport, remedy

WORDS = {"ok": "fine", "warn": "to look at", "fail": "not good", "none": "without a note"}


def render(
    *,
    name: str,
    chapters: Sequence[ChapterReport],
    judged: Sequence[Judged],
    metrics: Mapping[str, Mapping[str, Any]],
    reasons: Mapping[str, str],
    methods: str,
) -> dict[str, str]:
    """Return the text of every page by file name."""
    loader, undefined = jinja2.PackageLoader("stages.report"), jinja2.StrictUndefined
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=undefined
    )
    environment.filters |= {"number": metric_words.number, "in_words": in_words}
    environment.globals |= {"describe": metric_words.describe, "remedy": remedy}
    shared = {"name": name, "chapters": chapters, "judged": judged, "words": WORDS, "marks": qa.MARKS}
    index = environment.get_template("index.html")
    pages = {"index.html": index.render(**shared, metrics=metrics, reasons=reasons, methods=methods)}
    chapter = environment.get_template("chapter.html")
    for before, shown, after in zip((None, *chapters), chapters, (*chapters[1:], None), strict=False):
        file = f"{shown.chapter.artifact}.html"
        pages[file] = chapter.render(**shared, shown=shown, before=before, after=after)
    return pages


def in_words(check: str) -> str:
    """Return a check's name; metric keys are spelled out in words."""
    group, _, rest = check.partition("/")
    return f"{group}: {metric_words.describe(check).text}" if rest and " " not in check else check
