"""The report judges honestly, shows every note and asks nothing of the network."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from pipeline import artifact, dag, qa
from pipeline.cli import Task
from pipeline.videos import Video
from stages.report import bars, pages
from stages.report.__main__ import Config, run
from stages.report.chapters import CHAPTERS

ROLES = (
    ("walkthrough", "none"),
    ("turnaround", "none"),
    ("session", "train"),
    ("session", "test"),
    ("heldout", "none"),
)
VIDEOS = tuple(Video(f"v{number:03d}", "a.r3d", role, split, None) for number, (role, split) in enumerate(ROLES))


def write_notes(build: Path, metrics: dict[str, float | None], reasons: dict[str, str]) -> dict[str, Path]:
    """Write one small artifact per chapter, or per recording, with a note and a picture."""
    rng = np.random.default_rng(0)
    for chapter in CHAPTERS:
        videos = [video.id for video in VIDEOS if video.role in dag.NODES[chapter.artifact].roles] if chapter.per_video else [""]
        for video in videos:
            with artifact.create(build / chapter.artifact / video, stage=chapter.artifact, config={"steps": 7}, inputs={}) as folder:
                picture = qa.Picture("view", rng.integers(0, 255, (24, 80, 3), dtype=np.uint8), f"a view of {chapter.artifact}")
                checks = [qa.Check("leak <script>", 2.0, "px", warn=1.0, fail=3.0), qa.Check("unmeasured", None)]
                qa.write(folder, good="sharp", bad="blurred", checks=checks, pictures=[picture])
                if chapter.artifact == "evaluation":
                    (folder / "metrics.json").write_text(json.dumps(metrics))
                    (folder / "reasons.json").write_text(json.dumps(reasons))
    return {chapter.artifact: build / chapter.artifact for chapter in CHAPTERS}


def make_report(build: Path, out: Path) -> dict[str, str]:
    """Run the stage and return its pages."""
    paths = write_notes(build, {"masks/iou_mean": 0.5, "reconstruction/lpips_all": None}, {"reconstruction/lpips_all": "no weights"})
    run(Task("report", Config(name="toy"), out, None, VIDEOS, None, 1, None, paths, "cpu"))
    return {path.name: path.read_text() for path in out.glob("*.html")}


def test_every_note_is_shown_and_nothing_is_asked_for(tmp_path: Path) -> None:
    texts = make_report(tmp_path / "first", tmp_path / "report")
    assert set(texts) == {"index.html", *(f"{chapter.artifact}.html" for chapter in CHAPTERS)}
    for name, text in texts.items():
        assert re.search("https?://", text) is None, name
        assert set(re.findall(r'(?:src|href)="([a-z]+):', text)) <= {"data"}, name
        assert "leak <script>" not in text, "names are escaped"
    for chapter in CHAPTERS:
        assert f"a view of {chapter.artifact}" in texts[f"{chapter.artifact}.html"]
        assert f'href="{chapter.artifact}.html"' in texts["index.html"]
    assert all(f'id="{video.id}"' in texts["frames.html"] for video in VIDEOS)
    assert "no weights" in texts["index.html"]


def test_same_notes_same_bytes(tmp_path: Path) -> None:
    assert make_report(tmp_path / "first", tmp_path / "one") == make_report(tmp_path / "second", tmp_path / "two")


@pytest.mark.parametrize(("value", "verdict"), [(0.75, "ok"), (0.9, "ok"), (0.74, "fail"), (None, "none"), (float("nan"), "none")])
def test_a_limit_may_be_met(value: float | None, verdict: str) -> None:
    judged = {row.bar.metric: row for row in bars.judge({"masks/iou_mean": value}, {"masks/iou_mean": "no truth"})}
    assert judged["masks/iou_mean"].verdict == verdict
    assert (judged["masks/iou_mean"].reason == "no truth") == (verdict == "none")


def test_a_rival_must_be_beaten_and_all_videos_reached() -> None:
    even = {"behavior/ats/goal_minde_m": 0.3, "behavior/stand_still/goal_minde_m": 0.3}
    assert [row.verdict for row in bars.judge(even, {}) if row.bar.limit == "behavior/stand_still/goal_minde_m"] == ["fail"]
    for found, verdict in ((5, "fail"), (6, "ok")):
        counts = {"registration/videos_registered": found, "registration/videos_total": 6}
        assert [row.verdict for row in bars.judge(counts, {}) if row.bar.limit == "registration/videos_total"] == [verdict]


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (3.0, "3"), (0.0, "0"), (0.12345, "0.123"), (1234.5, "1234"), (0.00012, "1.2e-04"), (12.345, "12.3")],
)
def test_numbers_are_readable(value: float | None, text: str) -> None:
    assert pages.number(value) == text
