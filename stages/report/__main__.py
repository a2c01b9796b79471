"""Write the report of a build: an index with traffic lights and figures, and one page per stage.

Reads the notes (`qa.json`, pictures, settings) of every artifact and `evaluation/metrics.json`; computes nothing
again. Every page is one file that can be sent by itself and asks nothing of the network.
"""

import json
from dataclasses import dataclass
from pathlib import Path

from pipeline import artifact, cli, qa
from pipeline.cli import Task
from stages.report import bars, collect, pages
from stages.report.chapters import CHAPTERS, Chapter


@dataclass(frozen=True)
class Config:
    """How the report is written."""

    name: str = "the animal"
    """what it calls the animal"""
    share_safe: bool = False
    """blur every picture that people or the home can be in; drawn ones, the animal alone and figures stay"""
    warn_page_mb: float = 15.0
    """megabytes above which a page is too big to send"""


def run(task: Task) -> None:
    """Collect, judge, render."""
    evaluation = task.input("evaluation")
    metrics, reasons = (json.loads((evaluation / file).read_bytes()) for file in ("metrics.json", "reasons.json"))
    abouts = {video.id: collect.about(video, task.config.share_safe) for video in task.videos}
    chapters = [told(task, chapter, abouts) for chapter in CHAPTERS]
    judged, figures = bars.judge(metrics, reasons), bars.grouped(metrics)
    texts = pages.render(name=task.config.name, chapters=chapters, judged=judged, figures=figures, reasons=reasons)
    with task.create() as folder:
        for file, text in texts.items():
            (folder / file).write_text(text)
        largest_mb = max(len(text.encode()) for text in texts.values()) / 1e6
        size = qa.Check("largest page", largest_mb, "MB", warn=task.config.warn_page_mb)
        qa.write(folder, good="every page opens and can be sent", bad="pages too big to send", checks=[size])


def told(task: Task, chapter: Chapter, abouts: dict[str, str]) -> collect.Told:
    """Open the chapter's artifacts, by recording where there is one for each, and read their notes."""
    folders: dict[str | None, Path] = {**task.per_video(chapter.artifact)} if chapter.per_video else {None: task.input(chapter.artifact)}
    manifest = artifact.read_manifest(next(iter(folders.values()), task.out))
    return collect.told(chapter, folders, abouts, manifest.config if manifest else {}, task.config.share_safe)


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=tuple(chapter.artifact for chapter in CHAPTERS), options=("share_safe",))
