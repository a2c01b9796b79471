"""The planner: roles, split, ids, keys, and refusals without side effects."""

import json
import os
import re
import shutil
import unicodedata

import pytest

from pipeline.core.errors import InputError
from pipeline.workflow import captures
from pipeline.workflow.captures import Remarks, assign, builtin
from tests.pipeline.workflow import checkout


@pytest.fixture
def small_checkout(tmp_path):
    return checkout.create(tmp_path)


def assigned(names, ids=None, **said):
    remarks = {name: said.get(name.split(".")[0], Remarks()) for name in names}
    return {video.file: video for video in assign(remarks, ids or {}, dict.fromkeys(names), "captures/cat")}


NAMES = ["walkthrough.r3d", "b.r3d", "a.r3d", "turnaround 1.r3d", "heldout.r3d"]


def test_file_names_determine_roles_order_and_split():
    videos = assigned(NAMES)
    assert [(v.id, v.file, v.role, v.split) for v in sorted(videos.values(), key=lambda v: v.id)] == [
        ("v000", "walkthrough.r3d", "walkthrough", "none"),
        ("v001", "turnaround 1.r3d", "turnaround", "none"),
        ("v002", "a.r3d", "session", "train"),
        ("v003", "b.r3d", "session", "test"),
        ("v004", "heldout.r3d", "heldout", "none"),
    ]


def test_recipe_overrides_file_names():
    videos = assigned(
        NAMES, a=Remarks(split="test"), heldout=Remarks(synchronized_with="a.r3d", offset_s=0.5)
    )
    assert (videos["a.r3d"].split, videos["b.r3d"].split) == ("test", "train")
    assert (videos["heldout.r3d"].synchronized_with, videos["heldout.r3d"].offset_s) == (
        videos["a.r3d"].id,
        0.5,
    )


def test_single_session_is_not_a_test_session():
    assert assigned(["walkthrough.r3d", "turnaround.r3d", "x.r3d"])["x.r3d"].split == "train"


def test_ids_are_stable_and_never_reused():
    first = {name: video.id for name, video in assigned(NAMES).items()}
    later = assigned([*[n for n in NAMES if n != "a.r3d"], "0.r3d"], ids=first)
    assert all(later[name].id == first[name] for name in later if name in first)
    assert later["0.r3d"].id == "v005"


def test_damaged_plan_files_are_rewritten(small_checkout):
    small_checkout.plan()
    sound = {
        name: small_checkout.folder / f"build/toy/plan/{name}"
        for name in ("ids.json", "cache.json", "rules.mk")
    }
    before = {name: path.read_bytes() for name, path in sound.items()}
    for broken in ("[]", '{"a": 1}', '{"a": {"mark": [], "value": {}}}'):
        for name in ("ids.json", "cache.json"):
            sound[name].write_text(broken)
        assert small_checkout.plan().stderr == ""
        assert {name: path.read_bytes() for name, path in sound.items()} == before


@pytest.mark.parametrize("missing", ["walkthrough", "turnaround", "session"])
def test_incomplete_capture_is_refused(missing):
    names = [
        name for name in ("walkthrough.r3d", "turnaround.r3d", "session.r3d") if not name.startswith(missing)
    ]
    with pytest.raises(InputError, match=f"CAP-040.*no {missing}.*: '.*' is a "):
        assigned(names)


def test_accents_may_be_stored_apart_from_their_letters(tmp_path):
    """As macOS does: the recipe is typed with `ü` as one character."""
    stored = unicodedata.normalize("NFD", "über.r3d")
    names = ["walkthrough.r3d", "turnaround.r3d", "a.r3d", stored, "heldout.r3d"]
    recipe = {"über.r3d": {"split": "test"}, "heldout.r3d": {"synchronized_with": "über.r3d"}}
    assert stored not in recipe
    said = captures.remarks(tmp_path, names, recipe, "cat.toml")
    videos = {v.file: v for v in assign(said, {}, dict.fromkeys(names), "")}
    assert videos[stored].split == "test" and videos["a.r3d"].split == "train"
    assert videos["heldout.r3d"].synchronized_with == videos[stored].id


@pytest.mark.parametrize(
    "remark", [Remarks(role="film"), Remarks(split="tset"), Remarks(synchronized_with="c.r3d")]
)
def test_invalid_sidecar_is_refused(remark):
    with pytest.raises(InputError, match="CAP-041"):
        assigned(NAMES, a=remark)


def test_builtin_capture_has_a_session_for_the_held_out_phone():
    said = builtin(3, heldout_of=2)
    videos = {v.file: v for v in assign(said, {}, dict.fromkeys(said), "")}
    assert videos["heldout.r3d"].synchronized_with == videos["session-2.r3d"].id
    assert "heldout.r3d" not in builtin(3, heldout_of=0)


def test_turnarounds_of_several_animals_are_assigned_by_name():
    names = ["walkthrough.r3d", "turnaround_cat.r3d", "TURNAROUND_Rex.r3d", "a.r3d"]
    assert {v.file: v.animal for v in assigned(names).values()} == dict(
        zip(names, (None, "cat", "rex", None), strict=True)
    )
    one = assigned(["walkthrough.r3d", "turnaround_cat.r3d", "a.r3d"])
    assert one["turnaround_cat.r3d"].animal is None, "alone it needs no name"


@pytest.mark.parametrize(
    "names",
    [
        ("turnaround_cat.r3d", "turnaround_cat.mp4"),
        ("turnaround.r3d", "turnaround_cat.r3d"),
        ("turnaround_m\u00fcsli.r3d", "turnaround_cat.r3d"),
        ("turnaround_mu\u0308sli.r3d", "turnaround_cat.r3d"),
        ("turnaround_person.r3d", "turnaround_cat.r3d"),
    ],
)
def test_turnarounds_that_name_no_animals_of_their_own_are_refused(names):
    with pytest.raises(InputError, match="CAP-043"):
        assigned(["walkthrough.r3d", *names, "a.r3d"])


TWO = ("walkthrough.r3d", "turnaround_cat.r3d", "turnaround_dog.r3d", "a.r3d")


@pytest.mark.slow
def test_animals_of_a_home_share_the_scene_artifacts(small_checkout):
    small_checkout.record(*TWO)
    made = small_checkout.make("-j2", "toy.behavior_data")
    assert made.returncode == 0, made.stderr
    for shared in ("frames/v000", "flow/v001", "features/v002", "scene_localizer", "identities"):
        assert (small_checkout.folder / "build/toy" / shared / "manifest.json").exists(), shared
    for name, own, other in (("cat", "v001", "v002"), ("dog", "v002", "v001")):
        folder = small_checkout.folder / "build/toy/animals" / name
        assert (folder / "masks" / own / "manifest.json").exists()
        assert not (folder / "masks" / other).exists(), "the other's turnaround is not its own"
        assert not (folder / "frames").exists(), "shared"
    page = small_checkout.make("-j2", "toy.home_simulator")
    assert page.returncode == 0, page.stderr
    job = small_checkout.jobs()["home_simulator"]
    assert sorted(each["name"] for each in job["inputs"]) == sorted(
        f"{name}/{part}"
        for name in ("cat", "dog")
        for part in ("reconstruction", "splats", "behavior", "behavior_data")
    )
    contents = [
        (small_checkout.folder / f"build/toy/animals/{name}/reconstruction/0.bin").read_bytes()
        for name in ("cat", "dog")
    ]
    assert contents[0] != contents[1]
    again = small_checkout.make("-j2", "toy.behavior_data")
    assert "begins" not in again.stderr, "nothing changed"
    asked = ("behavior", "behavior_data")
    together = small_checkout.python("pipeline.workflow.plan", "together", "toy", *asked)
    assert together.stdout == "--animals build/toy/animals\n"
    shared = small_checkout.python("pipeline.workflow.plan", "together", "toy", *asked, "feature_basis")
    assert shared.stdout == "--animals build/toy/animals --feature-basis build/toy/feature_basis\n"
    one = small_checkout.python("pipeline.workflow.plan", "together", "toy/animals/cat", *asked).stdout
    assert one.startswith("--behavior build/toy/animals/cat/behavior ")
    for home, code in (("toy", "REC-008"), ("toy/animals/bird", "REC-007.*bird: no such animal\n.*cat, dog")):
        assert re.search(
            code, small_checkout.python("pipeline.workflow.plan", "inputs", home, *asked).stderr
        ), code
    refused = small_checkout.plan("toy/variants/other")
    assert refused.returncode == 2
    assert "REC-008" in refused.stderr


RECORDED = ("walkthrough.r3d", "turnaround.r3d", "a.r3d")
FILES = {f"captures/toy/{name}": name for name in RECORDED}
HOSTILE = ["$(shell touch hacked).r3d", "`touch hacked`.r3d", "a b'\"\n;c.r3d", "-rf.r3d", "%.r3d", "#.r3d"]


@pytest.mark.slow
def test_jobs_and_copies_are_named_by_their_files(small_checkout):
    small_checkout.record("walkthrough.r3d", "turnaround.r3d", "a.r3d", "b.r3d")
    assert small_checkout.plan().stdout == ""
    jobs = small_checkout.jobs()
    assert jobs["masks.v003"]["place"].endswith(f" of {len(jobs)}: 'b.r3d'")
    assert jobs["behavior"]["place"].endswith(f" of {len(jobs)}")
    small_checkout.write("captures/toy/c.r3d", "a.r3d")
    assert small_checkout.plan().stdout == "[toy] 'c.r3d' is a copy of 'a.r3d': keep only one\n"


def test_an_unknown_animal_is_refused_before_anything_is_built(small_checkout):
    small_checkout.record("walkthrough.r3d", "turnaround_cat.r3d", "turnaround_dog.r3d", "a.r3d")
    for command in ("export", "simulate", "serve", "verify"):
        refused = small_checkout.make(command, "AGENT=toy", "NAME=bird")
        assert refused.returncode == 2 and "REC-007" in refused.stderr and "cat, dog" in refused.stderr
        assert "begins (" not in refused.stderr
    (small_checkout.folder / "captures/toy/turnaround_dog.r3d").unlink()
    shutil.rmtree(small_checkout.folder / "build")
    assert "leave out NAME=" in small_checkout.make("serve", "AGENT=toy", "NAME=cat").stderr
    built = small_checkout.make("toy.frames", "NAME=dog")
    assert built.returncode == 2 and "a build makes all animals of a home" in built.stderr


def test_misspelled_variables_are_refused(small_checkout):
    refused = small_checkout.make("toy", "VARAINT=other")
    assert (
        refused.returncode == 2 and "REC-004 there is no variable VARAINT: known are AGENT" in refused.stderr
    )
    assert not (small_checkout.folder / "build").exists()
    spaces = ["AGENT=toy", "SUBGOALS=my goals x=3.toml", "GUIDANCE=person=1.5 dog=2", "-n"]
    assert "no variable" not in small_checkout.make("simulate", *spaces).stderr


def test_one_build_alone_is_removed(small_checkout):
    for name in ("build/toy/x", "build/toy/variants/other/x", "build/cat/x"):
        small_checkout.write(name, "")
    assert small_checkout.make("clean", "AGENT=toy", "VARIANT=other").returncode == 0
    assert (small_checkout.folder / "build/toy/x").exists()
    assert not (small_checkout.folder / "build/toy/variants/other").exists()
    assert small_checkout.make("clean", "AGENT=toy").returncode == 0
    assert [path.name for path in (small_checkout.folder / "build").iterdir()] == ["cat"]
    assert small_checkout.make("clean").returncode == 0
    assert not (small_checkout.folder / "build").exists()


def test_file_names_are_never_executed(small_checkout):
    small_checkout.record("walkthrough.r3d", "turnaround.r3d", *HOSTILE)
    made = small_checkout.make("-j2", "toy.frames")
    assert made.returncode == 0, made.stderr
    assert not (small_checkout.folder / "hacked").exists()
    videos = json.loads((small_checkout.folder / "build/toy/plan/videos.json").read_text())
    assert {video["file"] for video in videos} >= set(HOSTILE)


def test_unused_recordings_are_left_out_and_keep_their_ids(small_checkout):
    def ids():
        assert small_checkout.plan().returncode == 0
        videos = json.loads((small_checkout.folder / "build/toy/plan/videos.json").read_text())
        return {video["file"]: video["id"] for video in videos}

    small_checkout.record("walkthrough.r3d", "turnaround.r3d", "a.r3d", "b.r3d")
    before = ids()
    small_checkout.write("captures/toy/a.r3d.toml", 'role = "unused"\n')
    assert ids() == {name: each for name, each in before.items() if name != "a.r3d"}
    small_checkout.write("captures/toy/a.r3d.toml", "")
    assert ids() == before


def test_unknown_agents_are_refused_with_a_reason(small_checkout):
    small_checkout.write("captures/toy/scan/inner/rgb.mp4", "")
    small_checkout.write("captures/toy/scan/inner/odometry.csv", "")
    (small_checkout.folder / "captures/toy/monday.r3d").symlink_to("/nowhere")
    output = small_checkout.plan().stderr
    assert "'monday.r3d' (a link that leads nowhere), 'scan' (move 'inner' out of it: that is one)" in output


@pytest.mark.parametrize(
    ("arguments", "files", "code"),
    [
        (["plan", "../x"], {}, "REC-004"),
        (["new", "../x"], {}, "REC-004"),
        (["new", ""], {}, "REC-004"),
        (["plan", "toy/variants/../.."], {}, "REC-004"),
        (["plan", "dog"], {}, "REC-005"),
        (["plan", "toy/variants/none"], {}, "REC-005"),
        (["plan", "toy"], {"agents/toy.toml": "[segment_agents]\nseed = 1\n"}, "REC-001"),
        (["plan", "toy"], {"agents/toy.toml": "[segment_agent]\nsead = 1\n"}, "REC-001"),
        (["plan", "toy"], {"agents/toy.toml": "[scene_localizer]\ntarget = 'agent'\n"}, "REC-001"),
        (["plan", "toy"], {"agents/toy.toml": "seed = 1\n"}, "REC-001"),
        (["plan", "toy"], {"agents/toy.toml": "segment_agent = 1\n"}, "REC-002"),
        (["plan", "toy"], {"agents/toy.toml": "[segment_agent]\nseed = '1'\n"}, "REC-002"),
        (["plan", "toy"], {"agents/toy.toml": "[segment_agent\n"}, "REC-003"),
        (["plan", "toy"], {"agents/toy.toml": "[videos.'other.r3d']\nsplit = 'test'\n"}, "REC-001"),
        (["plan", "toy"], {"agents/toy.toml": "[flow]\nbegins_at = ['x']\n"}, "REC-002"),
        (["plan", "toy"], {**FILES, "captures/toy/a.r3d.toml": f"offset_s = {'9' * 400}\n"}, "REC-002"),
        (["plan", "toy"], {**FILES, "captures/toy/a.r3d.toml": "offset_s = nan\n"}, "CAP-041"),
        (["plan", "toy"], {**FILES, f"captures/toy/{'a' * 249}.r3d": "x"}, "CAP-041"),
        (["plan", "toy"], {**FILES, "captures/toy/b\udcff.r3d": "x"}, "CAP-041"),
        (["new", "clean", "test", "clean"], {}, "REC-004"),
        (["plan", "toy"], {"captures/toy/session.heic": "x"}, "CAP-003"),
        (["plan", "toy"], {"captures/toy/.walkthrough.r3d.icloud": "x"}, "CAP-003"),
        (["plan", "toy"], {"captures/toy": "a file"}, "CAP-042"),
        (["plan", "toy"], {**FILES, "captures/toy/a.r3d.toml": "split = 'test'\n"}, "CAP-041"),
        (["plan", "toy"], {**FILES, "captures/toy/a.r3d.toml": "synchronized_with = 'b.r3d'\n"}, "CAP-041"),
        (["plan", "toy"], {"captures/toy/walkthrough.r3d": "x", "captures/toy/a.r3d": "x"}, "CAP-040"),
    ],
)
def test_refusals_have_no_side_effects(small_checkout, arguments, files, code):
    for name, text in files.items():
        small_checkout.write(name, text)
    before = small_checkout.tree()
    refused = small_checkout.python("pipeline.workflow.plan", *arguments)
    assert refused.returncode == 2
    assert refused.stderr.startswith(f"error: {code} ")
    assert "\n  -> " in refused.stderr
    assert "Traceback" not in refused.stderr
    assert small_checkout.tree() == before


def test_lost_recordings_do_not_become_the_built_in_capture(small_checkout):
    small_checkout.record(*RECORDED)
    assert small_checkout.plan().returncode == 0
    captures, elsewhere = small_checkout.folder / "captures/toy", small_checkout.folder / "disk"
    captures.rename(elsewhere)
    captures.symlink_to(elsewhere)
    assert small_checkout.plan().returncode == 0
    elsewhere.rename(small_checkout.folder / "unplugged")
    refused = small_checkout.plan()
    assert refused.returncode == 2 and "CAP-042" in refused.stderr and "which is gone" in refused.stderr
    captures.unlink()
    captures.mkdir()
    refused = small_checkout.plan()
    assert refused.returncode == 2 and "is empty, but build/toy was built from" in refused.stderr


def test_control_characters_in_names_are_escaped(small_checkout):
    small_checkout.record(*RECORDED)
    small_checkout.write("captures/toy/\x1b[2Jnot\na recording", "")
    small_checkout.write("captures/toy/heldout\x1b[2J\n.r3d", "x")
    for _ in range(2):  # planned first, then from the cache
        output = small_checkout.plan().stdout
        assert "\x1b" not in output and len(output.splitlines()) == 2


def test_circular_links_are_not_followed(small_checkout):
    small_checkout.record(*RECORDED)
    small_checkout.write("captures/toy/scan/rgb.mp4", "x")
    small_checkout.write("captures/toy/scan/odometry.csv", "x")
    for link, target in (("scan/a", "."), ("scan/b", "."), ("c.r3d", "c.r3d"), ("elsewhere", "/nowhere")):
        (small_checkout.folder / "captures/toy" / link).symlink_to(target)
    for _ in range(2):
        completed = small_checkout.plan()
        assert completed.returncode == 0, completed.stderr
        assert "'c.r3d' (a link that leads nowhere)" in completed.stdout


def test_changes_behind_a_linked_recording_are_detected(small_checkout):
    small_checkout.record(*RECORDED)
    small_checkout.write("phone/scan/rgb.mp4", "x")
    small_checkout.write("phone/scan/odometry.csv", "x")
    (small_checkout.folder / "captures/toy/scan").symlink_to(small_checkout.folder / "phone/scan")
    hashes = set()
    for text in "xy":
        small_checkout.write("phone/scan/rgb.mp4", text)
        assert small_checkout.plan().returncode == 0
        videos = json.loads((small_checkout.folder / "build/toy/plan/videos.json").read_text())
        hashes.add(next(video["sha256"] for video in videos if video["file"] == "scan"))
    assert len(hashes) == 2


def test_variant_shares_unaffected_artifacts(small_checkout):
    small_checkout.write("agents/variants/other.toml", "[train_behavior]\nseed = 3\n")
    for home, own in (("toy", "build/toy"), ("toy/variants/other", "build/toy/variants/other")):
        small_checkout.plan(home)
        completed = small_checkout.python(
            "pipeline.workflow.plan", "inputs", home, "simulator", "behavior_data", "frames"
        )
        assert completed.stdout.split() == [
            "--simulator",
            f"{own}/simulator",
            "--behavior-data",
            "build/toy/behavior_data",
            "--frames",
            "build/toy/frames",
        ]
    refused = small_checkout.python("pipeline.workflow.plan", "inputs", "toy", "simulators")
    assert refused.returncode == 2 and refused.stderr.startswith("error: REC-007 ")
    unplanned = small_checkout.python("pipeline.workflow.plan", "redo", "nosuch", "masks")
    assert unplanned.returncode == 2 and unplanned.stderr.startswith("error: RUN-001 ")
    variant = small_checkout.python("pipeline.workflow.run", "toy/variants/paper", "masks")
    assert "run `make toy VARIANT=paper`" in variant.stderr
    listed = small_checkout.python("pipeline.workflow.plan", "redo", "toy", "pictures").stderr
    assert "REC-007" in listed and " frames," in listed and " pictures" not in listed.split("->")[1]


def key_files(small_checkout):
    folder = small_checkout.folder / "build/toy/plan/keys"
    return {path.name: path.read_text() for path in folder.iterdir()}


def changed_keys(small_checkout, before):
    """Plan again, and return the names of files in `keys` that are new or differ."""
    assert small_checkout.plan().returncode == 0
    return {name for name, text in key_files(small_checkout).items() if before.get(name) != text}


def test_only_relevant_changes_change_a_key(small_checkout):
    small_checkout.plan()
    before = key_files(small_checkout)
    front = small_checkout.folder / "stages/segment_agent/__main__.py"
    text = front.read_text()
    front.write_text(text.replace('"""Hash the inputs."""', '"""Other words."""  # and a comment\n'))
    assert changed_keys(small_checkout, before) == set()
    front.write_text(text.replace("* 64", "* 65"))
    small_checkout.write("stages/report/page.html", "<p>")
    small_checkout.write("agents/toy.toml", "[estimate_flow]\nseed = 2\n")
    assert changed_keys(small_checkout, before) == {"masks.json", "report.json", "flow.json"}


def test_files_that_a_stage_reads_and_programs_that_it_starts_are_its_code(small_checkout):
    small_checkout.record("walkthrough.r3d", "turnaround_cat.r3d", "turnaround_dog.r3d", "a.r3d")
    front = small_checkout.folder / "stages/build_scene_template/__main__.py"
    named = "def run(inputs, config, out):\n    program = Path(__file__).with_name('clean.py')\n"
    front.write_text(front.read_text().replace("def run(inputs, config, out):\n", named))
    small_checkout.write("stages/build_scene_template/clean.py", "print(1)")
    assert small_checkout.plan().returncode == 0
    before = key_files(small_checkout)
    small_checkout.write("stages/build_scene_template/clean.py", "print(2)")
    assert changed_keys(small_checkout, before) == {"scene_template.json"}
    before = key_files(small_checkout)
    small_checkout.write("stages/export_simulator/web/dist/page.html", "<p>")
    assert changed_keys(small_checkout, before) == {"home_simulator.json"}


def test_new_session_does_not_change_the_templates(small_checkout):
    small_checkout.record("walkthrough.r3d", "turnaround.r3d", "a.r3d", "b.r3d")
    small_checkout.plan()
    before = key_files(small_checkout)
    small_checkout.write("captures/toy/c.r3d", "c")
    changed = changed_keys(small_checkout, before)
    assert changed >= {"registration.json", "reconstruction.json", "behavior_data.json"}
    assert not changed & {
        "scene_template.json",
        "agent_template.json",
        "frames.json",
        "video.v002.json",
        "masks.json",
    }


def test_changed_recording_with_the_same_size_and_time_is_detected(small_checkout):
    small_checkout.record(*RECORDED)
    small_checkout.plan()
    before, path = key_files(small_checkout), small_checkout.folder / "captures/toy/a.r3d"
    age = path.stat()
    path.write_text("b.r3d")
    os.utime(path, ns=(age.st_atime_ns, age.st_mtime_ns))
    assert changed_keys(small_checkout, before) == {"video.v002.json"}


def test_walkthrough_without_depth_is_scaled_by_training_sessions(small_checkout):
    small_checkout.record("walkthrough.mp4", "turnaround.r3d", "a.r3d", "b.mp4", "c.r3d")
    small_checkout.plan()
    jobs = small_checkout.jobs()
    walk = jobs["frames.v000"]
    assert walk["arguments"][walk["arguments"].index("--captures") + 1] == "captures/toy"
    assert [key.rpartition("/")[2] for key in walk["keys"]] == [
        "frames.json",
        "video.v000.json",
        "video.v002.json",
    ]
    assert not [id for id, job in jobs.items() if "--captures" in job["arguments"] and id != "frames.v000"]
    small_checkout.write("captures/toy/a.r3d.depth.toml", "registered = true")
    small_checkout.plan()
    described = small_checkout.jobs()["frames.v000"]
    assert described["keys"] == [*walk["keys"], "build/toy/plan/keys/depth.v002.json"]
    assert described["arguments"] == walk["arguments"]


def test_clicks_are_an_input_of_reconstruction_metrics_only(small_checkout):
    small_checkout.record(*RECORDED)
    small_checkout.plan()
    before = key_files(small_checkout)
    small_checkout.write("captures/toy/clicks.json", "not even JSON")
    assert changed_keys(small_checkout, before) == {"extra.clicks.json"}
    jobs = small_checkout.jobs()
    assert [id for id, job in jobs.items() if "--clicks" in job["arguments"]] == ["reconstruction_metrics"]
    assert "extra.clicks.json" in str(jobs["reconstruction_metrics"]["keys"])


def test_changed_files_that_the_recipe_names_are_detected(small_checkout):
    small_checkout.record(*RECORDED)
    small_checkout.write("models/dinov2/model.safetensors", "weights")
    small_checkout.write("agents/toy.toml", '[fit_feature_basis]\nweights = "models/dinov2"\n')
    small_checkout.plan()
    before = key_files(small_checkout)
    assert changed_keys(small_checkout, before) == set()
    small_checkout.write("models/dinov2/model.safetensors", "further weights")
    assert changed_keys(small_checkout, before) == {"feature_basis.json"}
    before = key_files(small_checkout)
    small_checkout.write("models/dinov2/config.json", "{}")
    assert changed_keys(small_checkout, before) == {"feature_basis.json"}


def test_earlier_reconstruction_is_an_input_except_for_variants(small_checkout):
    small_checkout.record(*RECORDED)
    small_checkout.write("captures/toy/former/motion.npz", "unfinished")
    assert small_checkout.plan().returncode == 0
    before = key_files(small_checkout)
    assert not any("former" in name for name in before), "no artifact"
    small_checkout.write("captures/toy/former/manifest.json", "{}")
    small_checkout.write("agents/variants/longer.toml", "[reconstruct]\nseed = 7\n")
    assert small_checkout.plan("toy/variants/longer").returncode == 0
    assert changed_keys(small_checkout, before) == {"extra.former"}
    plans = [
        small_checkout.folder / "build/toy" / inside / "plan/dag.json" for inside in (".", "variants/longer")
    ]
    for plan, readers in zip(plans, (["reconstruction"], []), strict=True):
        assert [
            job["id"] for job in json.loads(plan.read_text()) if "--former" in job["arguments"]
        ] == readers
    assert captures.unknown_files(small_checkout.folder / "captures/toy") == []


def test_further_homes_are_inputs_of_the_behavior_model_only(small_checkout):
    small_checkout.record(*RECORDED)
    small_checkout.write("agents/toy.toml", '[train_behavior]\nhomes = ["summer"]\n')
    missing = small_checkout.plan()
    assert missing.returncode == 2 and "ART-003" in missing.stderr and "make summer" in missing.stderr
    for artifact in ("behavior_data", "feature_basis", "scene_template"):
        small_checkout.write(f"build/summer/{artifact}/world.json", "{}")
    assert small_checkout.plan().returncode == 0
    jobs = small_checkout.jobs()
    readers = {id for id, job in jobs.items() if any("summer" in each["path"] for each in job["inputs"])}
    assert readers == {"behavior"}
    assert [each["path"] for each in jobs["behavior"]["inputs"]] == [
        "build/toy/behavior_data",
        "build/toy/feature_basis",
        "build/toy/scene_template",
        "build/summer/behavior_data",
        "build/summer/feature_basis",
        "build/summer/scene_template",
    ]
    arguments = jobs["behavior"]["arguments"]
    assert arguments.count("--homes") == 1 and arguments[arguments.index("--homes") + 1] == "build"


@pytest.mark.parametrize("name", ["toy", "../cat", "pair/animals/dog"])
def test_home_that_is_no_other_build_is_refused(small_checkout, name):
    small_checkout.write("agents/toy.toml", f'[train_behavior]\nhomes = ["{name}"]\n')
    refused = small_checkout.plan()
    assert refused.returncode == 2 and "REC-002" in refused.stderr and name in refused.stderr


@pytest.mark.parametrize(
    ("kind", "job", "text"),
    [
        ("prompt", "masks.v003", "time_s = 2\nclick = [0.5, 0.5]"),
        ("depth", "frames.v003", "registered = true"),
    ],
)
def test_sidecar_is_an_input_of_one_job_of_its_recording_only(small_checkout, kind, job, text):
    small_checkout.record("walkthrough.r3d", "turnaround.r3d", "a.r3d", "b.r3d")
    small_checkout.plan()
    before = key_files(small_checkout)
    small_checkout.write(f"captures/toy/b.r3d.{kind}.toml", text)
    assert changed_keys(small_checkout, before) == {f"{kind}.v003.json"}
    given = {id: each for id, each in small_checkout.jobs().items() if f"--{kind}" in each["arguments"]}
    assert list(given) == [job], "b.r3d"
    assert f"captures/toy/b.r3d.{kind}.toml" in given[job]["arguments"]
    assert any(key.endswith(f"keys/{kind}.v003.json") for key in given[job]["keys"])
    assert captures.unknown_files(small_checkout.folder / "captures/toy") == []


@pytest.mark.parametrize("variable", ["AGENT", "VARIANT", "FORMAT", "PLACES"])
@pytest.mark.parametrize("value", ["x'; touch hacked; '", "a b", "../x", "$(touch hacked)", '"', ";"])
def test_names_passed_to_make_are_never_executed(small_checkout, variable, value):
    for target in ("help", "export", "annotate"):
        made = small_checkout.make("-n", target, f"{variable}={value.replace('$', '$$')}")
        assert made.returncode == 2
        assert f"REC-004 {variable} is no plain name" in made.stderr
    assert not (small_checkout.folder / "hacked").exists()


def test_session_without_depth_is_read_with_estimated_depth(small_checkout):
    small_checkout.record("walkthrough.r3d", "turnaround.mp4", "a.mp4", "b.r3d")
    small_checkout.plan()
    jobs = small_checkout.jobs()
    made = {name for name in jobs if name.split(".")[0] in ("frames", "pictures", "estimated_frames")}
    assert made == {
        "frames.v000", "frames.v003", "pictures.v001", "pictures.v002",
        "estimated_frames.v001", "estimated_frames.v002",
    }  # fmt: skip
    read = {name: {each["name"] for each in job["inputs"]} for name, job in jobs.items()}
    of_all = {"frames/v000", "scene_template"}
    assert of_all | {"pictures/v001"} == read["estimated_frames.v001"]
    assert {"frames/v000", "estimated_frames/v001", "masks/v001"} == read["recognizer"], (
        "once for all sessions"
    )
    assert of_all | {"recognizer", "pictures/v002"} == read["estimated_frames.v002"]
    assert "estimated_frames/v002" in read["masks.v002"] and "frames/v003" in read["masks.v003"]
    assert {job for job, names in read.items() if "recognizer" in names} == {
        "estimated_frames.v002", "masks.v002", "report",
    }  # fmt: skip
    assert not any(name.startswith("estimated") for name in read["feature_basis"]), "the map needs features"
    assert {"frames/v000", "estimated_frames/v001", "estimated_frames/v002"} <= read["reconstruction"]


def test_sessions_without_depth_of_several_animals_do_not_wait_for_masks(small_checkout):
    small_checkout.record("walkthrough.r3d", "turnaround_a.mp4", "turnaround_b.mp4", "s.mp4", "t.mp4")
    assert small_checkout.plan().returncode == 0
    jobs = json.loads((small_checkout.folder / "build/toy/plan/dag.json").read_text())
    read = {job["id"]: {each["name"] for each in job["inputs"]} for job in jobs if job["home"] == "toy"}
    sessions = [names for job, names in read.items() if job.startswith("estimated_frames.")]
    assert len(sessions) == 4 and not any(name.startswith("masks") for names in sessions for name in names)
    for animal in "ab":
        of_animal = small_checkout.folder / "build/toy/animals" / animal / "plan/dag.json"
        (report,) = [job for job in json.loads(of_animal.read_text()) if job["artifact"] == "report"]
        assert {"identities"} == {each["name"] for each in report["inputs"]} & {"identities", "recognizer"}


def test_report_of_recordings_with_depth_reads_no_recognizer(small_checkout):
    small_checkout.record("walkthrough.r3d", "turnaround.mp4", "a.r3d", "b.r3d")
    small_checkout.plan()
    read = {each["name"] for each in small_checkout.jobs()["report"]["inputs"]}
    assert {"frames/v000", "estimated_frames/v001"} <= read and read.isdisjoint({"identities", "recognizer"})


def test_make_starts_what_templates_need_first_and_long_recordings_before_short_ones(small_checkout):
    for name, size in {"walkthrough": 1, "turnaround": 1, "a": 10, "b": 30, "c": 20}.items():
        small_checkout.write(f"captures/toy/{name}.r3d", "x" * size)
    assert small_checkout.plan().returncode == 0
    rules = (small_checkout.folder / "build/toy/plan/rules.mk").read_text()
    listed = re.search(r"^toy: (.*)$", rules, re.MULTILINE)[1].replace("/.ok", "").split()
    order = [path.removeprefix("build/toy/") for path in listed]
    sessions = ["v003", "v004", "v002"]  # ids follow the names; b, c, a by size
    assert [name for name in order if name.startswith("video_poses/")] == [
        f"video_poses/{v}" for v in sessions
    ]
    place = {name: i for i, name in enumerate(order)}
    assert place["flow/v001"] < place["feature_basis"] < place["scene_localizer"] < place["masks/v003"]
    assert place["masks/v002"] < place["flow/v003"]
    assert len(place) == len(order)
