"""Recipes: start of the flow and trials of the tables."""

import json

import pytest

from pipeline.core.errors import InputError
from pipeline.workflow import recipes
from tests.pipeline.workflow import checkout


def test_overlays_are_merged_into_tables():
    table = {"seed": 1, "training": {"steps": 5, "augmentation": {"turn": 0.5}}}
    assert recipes.merged(table, {"training": {"augmentation": {"turn": 0.0}}}) == {
        "seed": 1,
        "training": {"steps": 5, "augmentation": {"turn": 0.0}},
    }
    assert table["training"]["augmentation"]["turn"] == 0.5


@pytest.mark.parametrize(
    "table", [{"begins_at": "pictures"}, {"begin": "recordings"}, {"begins_at": ["x"]}, {"begins_at": {}}]
)
def test_unknown_start_of_the_flow_is_refused(table):
    with pytest.raises(InputError, match="REC-00"):
        recipes.flow(table, "agents/cat.toml")


def test_every_method_has_every_seed():
    found = list(recipes.trials({"methods": ["ats", "world"], "seeds": 2}))
    assert [trial.id for trial in found] == ["ats-0", "ats-1", "world-0", "world-1"]
    assert found[0].overlay == {"seed": 0}
    assert found[3].overlay["ego"] == "world" and found[3].overlay["seed"] == 1


def test_a_method_trains_as_its_variant_does_whatever_else_that_changes():
    (_, trial) = recipes.trials({"methods": ["ats", "paper_small"], "seeds": 1})
    assert trial.overlay["encoding"] == "positions" and not trial.overlay["corrections"]
    with pytest.raises(InputError, match="REC-001.*reconstruct"):
        list(recipes.trials({"methods": ["ats", "mlp_fields"], "seeds": 1}))


@pytest.mark.parametrize("table", [{"seeds": 0}, {"methods": ["world"]}, {"methods": []}])
def test_empty_tables_and_tables_without_ours_are_refused(table):
    with pytest.raises(InputError, match="REC-002.*tabulate_behavior(.|\n)*'ats' among the methods"):
        list(recipes.trials(table))


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("[train_behavior.training.optimization]\nstepz = 1", "optimization: unknown key 'stepz'"),
        ("[train_behavior.training.optimization]\nsteps = 1.5", "optimization: steps: 1.5"),
        ("[train_behavior]\ntraining = 3", "training: 3 is no table"),
        ("[extract_frames]\nrate_hz = 0", "rate_hz: 0 cannot be"),
        ("[extract_frames]\nmax_depth_m = -1.0", "max_depth_m: -1.0 cannot be"),
        ("[extract_frames]\nmax_depth_m = nan", "max_depth_m: nan cannot be"),
        ("[synthesize_capture]\nsession_count = 'two'", "session_count: 'two'"),
        ("[synthesize_capture]\nforeign_sessions = -1", "foreign_sessions: -1 cannot be"),
        ("[tabulate_behavior]\nseeds = 1.5", "seeds: 1.5"),
        ("[tabulate_behavior]\nmethods = [1]", "methods.*1 is not str"),
        ("[segment_agent]\nbackend = 'sam'", "backend: 'sam'"),
        (f"[train_behavior]\nseed = {'9' * 400}", "seed: 99999"),
        (f"[extract_frames]\nrate_hz = {'9' * 400}", "rate_hz: 99999"),
        ("[videos]\n'a.r3d' = 3", "'a.r3d': 3 is no table"),
        ("[videos]\n'a.r3d'." + ".".join("a" * 5000) + " = 3", "'a.r3d': unknown key 'a'"),
        ("[videos.monday.r3d]\nsplit = 'test'", 'needs quotes\n.*write .videos."monday.r3d"'),
        (f"[videos.'a.r3d']\noffset_s = {'9' * 400}", "offset_s: 99999"),
    ],
)
def test_nested_tables_are_checked_by_the_planner(tmp_path, text, where):
    (tmp_path / "cat.toml").write_text(text)
    with pytest.raises(InputError, match=f"REC-00[12] .*{where}"):
        recipes.read(tmp_path / "cat.toml")


def test_variant_extends_its_base(tmp_path):
    variants = tmp_path / "variants"
    variants.mkdir()
    (variants / "a.toml").write_text("[reconstruct.steps]\nscene = 9\njoint = 8\n")
    (variants / "b.toml").write_text("base = 'a'\n[reconstruct.steps]\njoint = 7\n")
    assert recipes.read(variants / "b.toml")[0] == {"reconstruct": {"steps": {"scene": 9, "joint": 7}}}
    for wrong in ("'b'", "'c'", "3", "['a']"):
        (variants / "c.toml").write_text(f"base = {wrong}\n")
        with pytest.raises(InputError, match="(?s)REC-002 .*known: a"):
            recipes.read(variants / "c.toml")
    with pytest.raises(InputError, match="REC-001"):
        (tmp_path / "cat.toml").write_text("base = 'a'\n")
        recipes.read(tmp_path / "cat.toml")


def test_motion_tables_need_no_recordings(tmp_path):
    small_checkout = checkout.create(tmp_path)
    small_checkout.write("agents/dog.toml", '[flow]\nbegins_at = "trajectories"\n')
    for name in ("a.csv", "b.npz", "ignored.txt"):
        small_checkout.write(f"captures/dog/{name}", name)
    completed = small_checkout.plan("dog")
    assert completed.returncode == 0, completed.stderr
    assert "'ignored.txt'" in completed.stdout
    jobs = json.loads((tmp_path / "build/dog/plan/dag.json").read_text())
    assert [job["id"] for job in jobs] == [
        "trajectories.v000",
        "trajectories.v001",
        "behavior_data",
        "behavior",
    ]
    assert "captures/dog/a.csv" in jobs[0]["arguments"]
    videos = json.loads((tmp_path / "build/dog/plan/videos.json").read_text())
    assert [(video["file"], video["split"]) for video in videos] == [("a.csv", "train"), ("b.npz", "test")]
