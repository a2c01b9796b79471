"""A report's crate is enough to build again; what differs is named in flow order."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipeline.core import config
from pipeline.core.errors import InputError
from pipeline.core.videos import Video
from pipeline.workflow import artifact, reproduce
from stages.report import crate, methods

SETTINGS = {
    "frames": {"rate_hz": 10.0},
    "flow": {"backend": "search", "working_side_px": 1280},
    "masks": {"backend": "weightless"},
    "registration": {
        "note": 'a "quoted" word',
        "several": [1.0, 2.5],
        "inner": {"steps": 7, "deep": {"on": True}},
    },
}


def build(folder: Path, words: dict[str, str], sha256: str | None = None) -> Path:
    """Write small artifacts, with the crate that a report would hold of them; returns the crate."""
    found: dict[str, dict[str | None, Path]] = {}
    for name, settings in SETTINGS.items():
        ids = ["v000", "v001"] if name == "masks" else [None]
        for id in ids:
            place = folder / name / id if id else folder / name
            own = settings | ({"role": id} if id else {})
            with artifact.create(place, stage=name, config=own, inputs={}) as made:
                (made / "result.txt").write_text(words.get(place.relative_to(folder).as_posix(), "same"))
            found.setdefault(name, {})[id] = place
    (folder / "records").mkdir(exist_ok=True)
    (folder / "records" / "masks.v000.json").write_text(json.dumps({"seconds": 4.5, "threads": 1}))
    videos = (Video("v000", "walk.r3d", "walkthrough", "none", sha256),)
    described = crate.describe("toy", found, videos, {"masks/iou_mean": 0.8, "x/none": None})
    (folder / crate.FILE).write_text(json.dumps(described))
    return folder / crate.FILE


def test_the_first_artifact_that_differs_is_named(tmp_path: Path):
    known = reproduce.read(build(tmp_path / "a", {}))
    build(tmp_path / "same", {})
    assert list(reproduce.compare(known, tmp_path / "same")) == []
    build(tmp_path / "other", {"masks/v001": "moved", "registration": "moved"})
    assert reproduce.differing(known, tmp_path / "other") == ["masks/v001", "registration"]
    (tmp_path / "other" / "evaluation").mkdir()
    (tmp_path / "other" / "evaluation/metrics.json").write_text('{"masks/iou_mean": 0.7}')
    lines = list(reproduce.compare(known, tmp_path / "other"))
    assert "the first one is masks/v001" in lines[0] and "0.8 in the crate, 0.7 here" in lines[-1]


def test_an_artifact_that_was_not_built_differs(tmp_path: Path):
    known = reproduce.read(build(tmp_path / "a", {}))
    assert reproduce.differing(known, tmp_path / "nowhere")[0] == "frames"


def test_the_recipe_holds_the_settings(tmp_path: Path):
    (tmp_path / "recipe.toml").write_text(reproduce.recipe(reproduce.read(build(tmp_path / "a", {}))))
    table = config.read_table(tmp_path / "recipe.toml")
    assert table["gather_registration"] == SETTINGS["registration"]
    assert table["segment_agent"] == {"backend": "weightless"}, "what differs between recordings is left out"

    @dataclass(frozen=True)
    class Flow:
        backend: str = ""
        working_side_px: int = 0

    assert config.from_table(Flow, table["estimate_flow"], where="recipe") == Flow(**SETTINGS["flow"])


def test_recordings_are_found_by_their_hash(tmp_path: Path):
    captures, agents = tmp_path / "captures", tmp_path / "agents"
    (captures / "luna").mkdir(parents=True)
    agents.mkdir()
    (captures / "luna" / "renamed.r3d").write_bytes(b"recording")
    digest = reproduce.recording_digest(captures / "luna" / "renamed.r3d")
    known = reproduce.read(build(tmp_path / "a", {}, digest))
    name = reproduce.begin(known, agents, captures)
    assert (captures / name / "walk.r3d").read_bytes() == b"recording"
    assert (agents / f"{name}.toml").is_file()
    (captures / "luna" / "renamed.r3d").write_bytes(b"another one")
    with pytest.raises(InputError, match="CRT-002"):
        reproduce.begin(known, agents, captures)


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"@graph": [{"@id": "./"}]}', '{"@graph": 3}'])
def test_what_is_no_crate_is_refused(tmp_path: Path, text: str):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(InputError, match="CRT-001"):
        reproduce.read(tmp_path / "x.json")


def test_times_are_kept_and_methods_cite_what_was_used(tmp_path: Path):
    described = json.loads(build(tmp_path / "a", {}).read_text())
    masks = next(entity for entity in described["@graph"] if entity["@id"] == "#artifact/masks/v000")
    assert {"@type": "PropertyValue", "name": "seconds", "value": 4.5} in masks["additionalProperty"]
    folders = {name: {None: tmp_path / "a" / name} for name in ("frames", "flow")}
    assert "10 Hz" in methods.paragraph(folders) and "[kroeger2016fast]" in methods.paragraph(folders)
    assert "RAFT" not in methods.paragraph(folders)
    entries = methods.bibliography(folders)
    assert "@inproceedings{kroeger2016fast," in entries and "kerbl" not in entries
    assert all(key in methods.ENTRIES for method in methods.METHODS for key in method.cites)
