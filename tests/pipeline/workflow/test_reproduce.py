"""The crate of a report suffices to rebuild; differences are named in flow order."""

import json
import shutil
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


def build(folder: Path, words: dict[str, str], videos: tuple[Video, ...] = ()) -> Path:
    """Write small artifacts and the crate of their report; return the crate."""
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
    described = crate.describe("toy", found, videos, {"masks/iou_mean": 0.8, "x/none": None})
    (folder / crate.FILE).write_text(json.dumps(described))
    return folder / crate.FILE


def test_first_different_artifact_is_named(tmp_path: Path):
    known = reproduce.read(build(tmp_path / "a", {}))
    build(tmp_path / "same", {})
    assert list(reproduce.compare(known, tmp_path / "same")) == []
    build(tmp_path / "other", {"masks/v001": "moved", "registration": "moved"})
    assert reproduce.differing(known, tmp_path / "other") == ["masks/v001", "registration"]
    (tmp_path / "other" / "evaluation").mkdir()
    (tmp_path / "other" / "evaluation/metrics.json").write_text('{"masks/iou_mean": 0.7}')
    lines = list(reproduce.compare(known, tmp_path / "other"))
    assert "the first one is masks/v001" in lines[0] and "0.8 in the crate, 0.7 here" in lines[-1]


def test_changed_bytes_and_settings_are_named(tmp_path: Path):
    known = reproduce.read(build(tmp_path / "a", {}))
    (tmp_path / "a/flow/result.txt").write_text("sane")
    lines = list(reproduce.compare(known, tmp_path / "a"))
    assert "1 of 5 artifacts differ; the first one is flow" in lines[0]
    assert lines[1] == "  changed since it was written: result.txt"
    shutil.rmtree(tmp_path / "a/flow")
    with artifact.create(tmp_path / "a/flow", stage="flow", config={"backend": "raft"}, inputs={}) as made:
        (made / "result.txt").write_text("other")
    lines = list(reproduce.compare(known, tmp_path / "a"))
    assert "  backend: search in the crate, raft here" in lines


def test_missing_artifact_differs(tmp_path: Path):
    known = reproduce.read(build(tmp_path / "a", {}))
    assert reproduce.differing(known, tmp_path / "nowhere")[0] == "frames"


def test_recipe_contains_the_settings(tmp_path: Path):
    (tmp_path / "recipe.toml").write_text(reproduce.recipe(reproduce.read(build(tmp_path / "a", {}))))
    table = config.read_table(tmp_path / "recipe.toml")
    assert table["gather_registration"] == SETTINGS["registration"]
    assert table["segment_agent"] == {"backend": "weightless"}, "what differs between recordings is left out"

    @dataclass(frozen=True)
    class Flow:
        backend: str = ""
        working_side_px: int = 0

    assert config.from_table(Flow, table["estimate_flow"], where="recipe") == Flow(**SETTINGS["flow"])


def test_recordings_are_found_by_hash_and_planned_identically(tmp_path: Path):
    captures, agents, builds = (tmp_path / name for name in ("captures", "agents", "build"))
    (captures / "luna").mkdir(parents=True)
    agents.mkdir()
    for name in ("renamed.r3d", "other.mp4", "renamed.r3d.masks.toml", "clicks.json"):
        (captures / "luna" / name).write_text(name)
    digests = [reproduce.recording_digest(captures / "luna" / name) for name in ("renamed.r3d", "other.mp4")]
    videos = (
        Video("v000", "../luna/clicks.json", "session", "train", digests[0]),
        Video("v003", "v003", "heldout", "none", digests[1], synchronized_with="v000", offset_s=1.5),
    )
    known = reproduce.read(build(tmp_path / "a", {}, videos))
    for _ in range(2):
        name = reproduce.begin(known, agents, captures, builds)
    here = {path.name: path.read_text() for path in (captures / name).iterdir()}
    assert here == {
        "v000.r3d": "renamed.r3d",
        "v003.mp4": "other.mp4",
        "v000.r3d.masks.toml": "renamed.r3d.masks.toml",
        "clicks.json": "clicks.json",
    }
    said = config.read_table(agents / f"{name}.toml")["videos"]
    assert said["v000.r3d"] == {"role": "session", "split": "train"}
    clock = {"synchronized_with": "v000.r3d", "offset_s": 1.5}
    assert said["v003.mp4"] == {"role": "heldout", "split": "none", **clock}
    ids = json.loads((builds / name / "plan/ids.json").read_text())
    assert ids == {"v000.r3d": "v000", "v003.mp4": "v003"}
    (captures / "luna" / "renamed.r3d").write_bytes(b"another one")
    with pytest.raises(InputError, match="CRT-002"):
        reproduce.begin(known, agents, captures, builds)


def test_one_of_several_animals_is_refused(tmp_path: Path):
    video = Video("v001", "turnaround_rex.r3d", "turnaround", "none", None, animal="rex")
    known = reproduce.read(build(tmp_path / "a", {}, (video,)))
    with pytest.raises(InputError, match="CRT-003"):
        reproduce.begin(known, tmp_path, tmp_path, tmp_path)


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"@graph": [{"@id": "./"}]}', '{"@graph": 3}'])
def test_invalid_crate_is_refused(tmp_path: Path, text: str):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(InputError, match="CRT-001"):
        reproduce.read(tmp_path / "x.json")


def test_crate_keeps_times_and_cites_used_methods(tmp_path: Path):
    described = json.loads(build(tmp_path / "a", {}).read_text())
    masks = next(entity for entity in described["@graph"] if entity["@id"] == "#artifact/masks/v000")
    assert {"@type": "PropertyValue", "name": "seconds", "value": 4.5} in masks["additionalProperty"]
    folders: dict[str, dict[str | None, Path]] = {
        name: {None: tmp_path / "a" / name} for name in ("frames", "flow")
    }
    assert "10 Hz" in methods.paragraph(folders) and "[kroeger2016fast]" in methods.paragraph(folders)
    assert "RAFT" not in methods.paragraph(folders)
    entries = methods.bibliography(folders)
    assert "@inproceedings{kroeger2016fast," in entries and "kerbl" not in entries
    assert all(key in methods.ENTRIES for method in methods.METHODS for key in method.cites)
