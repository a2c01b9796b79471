"""The report shows every note, gives correct verdicts, and works offline."""

import ast
import base64
import dataclasses
import json
import re
from pathlib import Path

import jinja2
import numpy as np
import pytest

from pipeline.core.videos import Video
from pipeline.data import images, qa
from pipeline.metrics import bars, words
from pipeline.workflow import artifact, dag
from stages.evaluate.reconstruction_metrics.stage import JUDGED
from stages.evaluate.stage import FOOT_SKATE
from stages.report import collect, stage
from stages.report.collect import CHAPTERS, WORDS, remedy
from stages.report.config import Config
from tests.stages.export_simulator import browser

ROOT = Path(__file__).parents[3]
ROLES = (
    ("walkthrough", "none"),
    ("turnaround", "none"),
    ("session", "train"),
    ("session", "test"),
    ("heldout", "none"),
)
RNG = np.random.default_rng(0)
VIDEOS = tuple(
    Video(f"v{number:03d}", "a.r3d", role, split, None) for number, (role, split) in enumerate(ROLES)
)


def write_notes(build: Path, metrics: dict[str, float | None], reasons: dict[str, str]) -> dict[str, Path]:
    """Write one small artifact per chapter or recording, with a note and a picture."""
    rng = np.random.default_rng(0)
    for chapter in CHAPTERS:
        videos = (
            [video.id for video in VIDEOS if video.role in dag.NODES[chapter.artifact].roles]
            if chapter.per_video
            else [""]
        )
        for video in videos:
            with artifact.create(
                build / chapter.artifact / video,
                stage=dag.NODES[chapter.artifact].stage,
                config={"steps": 7},
                inputs={},
            ) as folder:
                picture = qa.Picture(
                    "view", rng.integers(0, 255, (24, 80, 3), dtype=np.uint8), f"a view of {chapter.artifact}"
                )
                checks = [
                    qa.Check("leak <script>", 2.0, "px", warn=1.0, fail=3.0),
                    qa.Check("unmeasured", None),
                ]
                qa.write(folder, good="sharp", bad="blurred", checks=checks, pictures=[picture])
                if chapter.artifact == "evaluation":
                    (folder / "metrics.json").write_text(json.dumps(metrics))
                    (folder / "reasons.json").write_text(json.dumps(reasons))
    return {chapter.artifact: build / chapter.artifact for chapter in CHAPTERS}


def inputs_of(paths: dict[str, Path]) -> stage.Inputs:
    """Return the artifacts as inputs of the stage."""
    several = {chapter.artifact for chapter in CHAPTERS if chapter.per_video}
    return stage.Inputs(
        **{
            name: {folder.name: folder for folder in sorted(path.iterdir())} if name in several else path
            for name, path in paths.items()
        }
    )


def make_report(build: Path, out: Path) -> dict[str, str]:
    """Run the stage and return its pages."""
    paths = write_notes(
        build,
        {"masks/iou_mean": 0.5, "reconstruction/lpips_all": None},
        {"reconstruction/lpips_all": "no weights"},
    )
    out.mkdir()
    stage.run(inputs_of(paths), Config(name="toy", times=False), out, videos=VIDEOS)
    return {path.name: path.read_text() for path in out.glob("*.html")}


def test_every_note_is_shown_without_network_requests(tmp_path: Path) -> None:
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
    assert "a.r3d <span" in texts["index.html"] and "unmeasured not measured" in texts["index.html"]
    assert collect.label(VIDEOS[0], safe=True).name == "v000"


def test_captions_name_recordings(tmp_path: Path) -> None:
    picture = qa.Picture("view", np.zeros((24, 80, 3), np.uint8), "v001: picture, v9 of v0012")
    qa.write(tmp_path, good="", bad="", pictures=[picture])
    (chapter,) = [each for each in CHAPTERS if each.artifact == "reconstruction"]
    labels = {"v001": collect.RecordingLabel("session-1.r3d")}
    (note,) = collect.read_chapter(chapter, {None: tmp_path}, labels).notes
    assert note.pictures[0].caption == "session-1.r3d: picture, v9 of v0012"


def chapter_report(artifact_name: str, light: str, *stands_on: str) -> collect.ChapterReport:
    chapter = next(chapter for chapter in CHAPTERS if chapter.artifact == artifact_name)
    note = collect.Note(None, collect.RecordingLabel(), light, "", "", [], [])
    return collect.ChapterReport(chapter, [note], {}, frozenset(stands_on))


def test_verdict_includes_the_inputs() -> None:
    chapters = [
        chapter_report("frames", "ok"),
        chapter_report("masks", "fail", "frames"),
        chapter_report("reconstruction", "warn", "masks"),
        chapter_report("simulator", "ok", "reconstruction"),
        chapter_report("evaluation", "ok", "frames"),
    ]
    judged = {each.chapter.artifact: each for each in collect.with_verdicts(chapters, {"evaluation": "fail"})}
    assert {name: each.light for name, each in judged.items()} == {
        "frames": "ok", "masks": "fail", "reconstruction": "fail", "simulator": "fail", "evaluation": "fail",
    }  # fmt: skip
    assert judged["simulator"].own_status == "ok"
    assert [cause.artifact for cause in judged["simulator"].causes] == ["masks"], (
        "the root, not what lies between"
    )
    assert judged["evaluation"].causes == (), "its own bars"


def test_masks_stand_on_networks_and_on_what_replaces_inputs(tmp_path: Path) -> None:
    """The inputs are those of manifests: stand-ins have no page of their own."""
    inputs = {
        "frames": ["pictures/v002", "recognizer"],
        "recognizer": ["frames/v001", "masks/v001"],
        "masks": ["estimated_frames/v002", "recognizer", "home_masks/v002"],
        "identities": ["frames/v001"],
    }
    read = {}
    for chapter in (each for each in CHAPTERS if each.artifact in inputs):
        with artifact.create(
            tmp_path / chapter.artifact,
            stage=dag.NODES[chapter.artifact].stage,
            config={},
            inputs=dict.fromkeys(inputs[chapter.artifact], "0" * 64),
        ) as folder:
            qa.write(folder, good="", bad="", checks=[qa.Check("recall", 1.0, warn=2.0, fail=3.0)])
        read[chapter.artifact] = collect.read_chapter(chapter, {None: tmp_path / chapter.artifact}, {})
    assert list(read) == ["frames", "identities", "recognizer", "masks"]
    for wrong in ("frames", "identities", "recognizer"):
        note = read[wrong].notes[0]
        notes = [collect.Note(None, note.label, "fail", "", "", note.checks, [])]
        wrong_one = [
            dataclasses.replace(each, notes=notes) if name == wrong else each for name, each in read.items()
        ]
        masks = collect.with_verdicts(wrong_one, {})[-1]
        assert masks.light == "fail" and [cause.artifact for cause in masks.causes] == [wrong]
    assert collect.with_verdicts(list(read.values()), {})[-1].light == "ok"


def test_pages_of_networks_only_where_there_are_some(tmp_path: Path) -> None:
    paths = write_notes(tmp_path, {}, {})
    given = dataclasses.replace(inputs_of(paths), identities=None, recognizer=None)
    (tmp_path / "report").mkdir()
    stage.run(given, Config(name="toy", times=False), tmp_path / "report", videos=VIDEOS)
    pages = {path.stem for path in (tmp_path / "report").glob("*.html")}
    assert pages == {"index", *(chapter.artifact for chapter in CHAPTERS)} - {"identities", "recognizer"}


def test_foot_skate_gives_a_warning() -> None:
    slide = {"behavior/ats/foot_slide_m_s": 0.14, "behavior/recorded/foot_slide_m_s": 0.04}
    judged = bars.judge(slide, {})
    assert [row.limit for row in judged if "foot" in row.bar.metric] == [pytest.approx(0.06)]
    assert bars.worst(judged) == "fail" and bars.worst(bars.judge({}, {})) == "ok"


def test_failed_limit_is_named(tmp_path: Path) -> None:
    texts = make_report(tmp_path / "first", tmp_path / "report")
    for page in ("index.html", "evaluation.html"):
        shown = " ".join(re.sub(r"<[^>]*>", " ", texts[page]).split())
        assert re.search(r"overlap of masks with the true animal:? \(?0.500 ,? ?\(?bar ≥ 0.750", shown), page
    assert "Bars" not in texts["masks.html"], "only where they are judged"


def test_comparison_sign_is_correct() -> None:
    met = {"behavior/ats/foot_slide_m_s": 0.06, "behavior/recorded/foot_slide_m_s": 0.04}
    (feet,) = [row for row in bars.judge(met, {}) if row.value is not None]
    assert (feet.bar.sign, feet.verdict) == ("≤", "ok"), "exactly at the limit"
    assert {bar.sign for bar in bars.BARS if "location prior" in bar.words} == {"<"}


def test_backticks_give_code(tmp_path: Path) -> None:
    environment = jinja2.Environment(loader=jinja2.PackageLoader("stages.report"), autoescape=True)
    macros = environment.get_template("layout.html").make_module({"words": {}, "marks": {}})
    assert str(macros.code("see `[a]` <b>")) == "see <code>[a]</code> &lt;b&gt;"
    texts = make_report(tmp_path / "first", tmp_path / "report")
    assert not any("`" in text for text in texts.values())


@pytest.mark.slow
@pytest.mark.skipif(not Path(browser.CHROMIUM).exists(), reason="Chromium is not installed")
def test_small_limits_fit_a_phone_screen(tmp_path: Path) -> None:
    texts = make_report(tmp_path / "first", tmp_path / "report")
    assert "≤ 1<" in texts["masks.html"]
    long = texts["masks.html"].replace("≤ 1<", "≤ 1.0e-04, ≤ 1.0e-04, ≤ 1.0e-04, ≤ 1.0e-04<")
    (tmp_path / "long.html").write_text(long)
    with browser.chromium() as opened:
        page = opened.new_page(viewport={"width": 390, "height": 844})
        page.goto((tmp_path / "long.html").as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= 390, "pixels"


def test_no_raw_key_is_shown(tmp_path: Path) -> None:
    index = make_report(tmp_path / "first", tmp_path / "report")["index.html"]
    shown = re.sub(r"<[^>]*>", " ", index)
    assert "overlap (IoU), mean" in shown and "LPIPS, whole picture" in shown
    assert not re.findall(r"\b[a-z]+_[a-z_]+\b", shown)
    assert "prefers-color-scheme: dark" in index


def test_report_is_deterministic(tmp_path: Path) -> None:
    assert make_report(tmp_path / "first", tmp_path / "one") == make_report(
        tmp_path / "second", tmp_path / "two"
    )


@pytest.mark.parametrize(
    ("value", "verdict"), [(0.75, "ok"), (0.9, "ok"), (0.74, "fail"), (None, "none"), (float("nan"), "none")]
)
def test_limits_are_inclusive(value: float | None, verdict: str) -> None:
    judged = {
        row.bar.metric: row for row in bars.judge({"masks/iou_mean": value}, {"masks/iou_mean": "no truth"})
    }
    assert judged["masks/iou_mean"].verdict == verdict
    assert (judged["masks/iou_mean"].reason == "no truth") == (verdict == "none")


def test_checks_of_baselines_and_coverage() -> None:
    even = {"behavior/ats/goal_minde_m": 0.3, "behavior/stand_still/goal_minde_m": 0.3}
    assert [
        row.verdict for row in bars.judge(even, {}) if row.bar.limit == "behavior/stand_still/goal_minde_m"
    ] == ["fail"]
    for found, verdict in ((5, "fail"), (6, "ok")):
        counts = {"registration/videos_registered": found, "registration/videos_total": 6}
        assert [
            row.verdict for row in bars.judge(counts, {}) if row.bar.limit == "registration/videos_total"
        ] == [verdict]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (3.0, "3"),
        (0.0, "0"),
        (0.12345, "0.123"),
        (1234.5, "1234"),
        (0.00012, "1.2e-04"),
        (12.345, "12.3"),
    ],
)
def test_numbers_are_readable(value: float | None, text: str) -> None:
    assert words.number(value) == text


def test_safe_report_blurs_camera_pictures(tmp_path: Path) -> None:
    """A blurred picture does not reveal pixels of the original; plots are unchanged."""
    sharp = RNG.integers(0, 255, (96, 240, 3), dtype=np.uint8)
    for name in ("masks", "behavior"):
        folder = tmp_path / name
        (folder / "qa").mkdir(parents=True)
        qa.write(folder, good="", bad="", checks=[], pictures=[qa.Picture("view", sharp, "a view")])
        chapter = next(chapter for chapter in CHAPTERS if chapter.artifact == name)
        shown = {
            safe: embedded(collect.read_chapter(chapter, {None: folder}, {}, safe)) for safe in (False, True)
        }
        detail = {
            safe: np.abs(np.diff(picture.astype(float), axis=1)).mean() for safe, picture in shown.items()
        }
        assert shown[True].shape == sharp.shape
        assert detail[True] < 0.1 * detail[False] if name == "masks" else detail[True] == detail[False]


def embedded(chapter: collect.ChapterReport) -> np.ndarray:
    """Decode the first picture of a chapter."""
    return images.decode_color(
        base64.b64decode(chapter.notes[0].pictures[0].source.partition(",")[2]), "report"
    )


def judged_checks() -> list[tuple[str, str]]:
    """Artifact and name of every check whose threshold is a literal in a stage."""
    found = []
    for chapter in CHAPTERS:
        for file in (ROOT / "stages" / dag.NODES[chapter.artifact].stage.replace(".", "/")).glob("*.py"):
            for call in ast.walk(ast.parse(file.read_text())):
                if (
                    not isinstance(call, ast.Call)
                    or ast.unparse(call.func) not in ("Check", "qa.Check")
                    or not call.args
                ):
                    continue
                name = call.args[0].values[0] if isinstance(call.args[0], ast.JoinedStr) else call.args[0]
                if isinstance(name, ast.Constant) and (
                    len(call.args) > 3 or {key.arg for key in call.keywords} & {"warn", "fail"}
                ):
                    found.append((chapter.artifact, str(name.value)))
    return found


def test_every_threshold_has_a_remedy() -> None:
    checks = judged_checks()
    bars_shown = [
        ("reconstruction_metrics", bar.metric) for bar in bars.BARS if bar.metric.startswith(JUDGED)
    ]
    checks += [*bars_shown, ("evaluation", FOOT_SKATE), ("evaluation", "behavior/ats_minus_stand_still/")]
    assert len(checks) > 50
    assert [each for each in checks if not remedy(*each)] == []


def test_warnings_have_a_remedy(tmp_path: Path) -> None:
    known = {
        (chapter.artifact, begin)
        for chapter in CHAPTERS
        for begin in WORDS["remedies"].get(chapter.artifact, {})
    }
    assert len(known) == sum(len(table) for table in WORDS["remedies"].values()), (
        "no remedy for an artifact without a page"
    )
    assert "walk once more" in remedy("scene_template", "keyframes registered by COLMAP")
    assert remedy("scene_template", "unheard of") == ""
    assert "unedited" in remedy("frames", "pictures against depth, intrinsics and poses (...)")
    assert "turnaround" in remedy("video_poses", "animal of the template's size (...)")
