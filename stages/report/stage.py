"""The stage: notes of every artifact, and the metrics -> pages, a crate to rebuild from, the methods."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.core.videos import Video
from pipeline.data import qa
from pipeline.metrics import bars
from pipeline.metrics.metrics import Metrics
from stages.report import collect, crate, methods, pages
from stages.report.collect import CHAPTERS
from stages.report.config import Config

WARN_PAGE_MB = 15.0
"""Mail servers refuse attachments of about 20 MB."""


@dataclass(frozen=True)
class Inputs:
    """What the stage reads: every artifact that has a page."""

    frames: Mapping[str, Path]
    flow: Mapping[str, Path]
    masks: Mapping[str, Path]
    feature_basis: Path
    features: Mapping[str, Path]
    scene_template: Path
    agent_template: Path
    scene_localizer: Path
    agent_localizer: Path
    video_poses: Mapping[str, Path]
    registration: Path
    reconstruction: Path
    splats: Path
    behavior_data: Path
    behavior: Path
    longterm: Path
    simulator: Path
    reconstruction_metrics: Path
    evaluation: Path
    identities: Path | None = None
    """Only in a home of several animals."""
    recognizer: Path | None = None
    """Only where sessions are plain videos."""

    def folders(self, artifact: str) -> dict[str | None, Path]:
        """Return an artifact's folders by recording; the key None if there is only one."""
        given: Path | Mapping[str | None, Path] = getattr(self, artifact)
        return {None: given} if isinstance(given, Path) else dict(given)


def run(inputs: Inputs, config: Config, out: Path, *, videos: tuple[Video, ...] = ()) -> None:
    """Collect notes, derive verdicts, render pages."""
    measured = Metrics.read(inputs.evaluation)
    shown = [chapter for chapter in CHAPTERS if getattr(inputs, chapter.artifact) is not None]
    folders = {chapter.artifact: inputs.folders(chapter.artifact) for chapter in shown}
    judged = bars.judge(measured.values, measured.reasons)
    labels = {video.id: collect.label(video, config.share_safe) for video in videos}
    read = [
        collect.read_chapter(chapter, folders[chapter.artifact], labels, config.share_safe)
        for chapter in shown
    ]
    chapters = collect.with_verdicts(read, {"evaluation": bars.worst(judged)})
    texts = pages.render(
        name=config.name,
        chapters=chapters,
        judged=judged,
        metrics=bars.grouped(measured.values),
        reasons=measured.reasons,
        methods=methods.paragraph(folders),
    )
    for file, text in texts.items():
        (out / file).write_text(text)
    (out / "methods.md").write_text(methods.document(folders))
    (out / "references.bib").write_text(methods.bibliography(folders))
    found = crate.describe(
        config.name, folders, videos, measured.values, safe=config.share_safe, times=config.times
    )
    (out / crate.FILE).write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")
    largest_mb = max(len(text.encode()) for text in texts.values()) / 1e6
    size = qa.Check("largest page", largest_mb, "MB", warn=WARN_PAGE_MB)
    qa.write(out, good="every page opens and can be sent", bad="pages too big to send", checks=[size])
