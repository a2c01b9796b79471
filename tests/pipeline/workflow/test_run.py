"""The runner and its engines: cut-off, redo, variants, failure, kills; Make and Snakemake agree."""

import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time

import pytest

from pipeline.workflow import artifact, run
from tests.pipeline.workflow import checkout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    house = checkout.create(tmp_path_factory.mktemp("house"))
    made = house.make("-j2", "toy")
    assert made.returncode == 0, made.stderr
    return house


@pytest.fixture
def house(built, tmp_path):
    """A copy of the built house, ages and all."""
    shutil.copytree(built.folder, tmp_path / "house", symlinks=True)
    return checkout.Checkout(tmp_path / "house")


def begun(made):
    assert made.returncode == 0, made.stderr
    return {line.split("]")[0][1:] for line in made.stderr.splitlines() if "] begins (" in line}


def contents(house):
    """Return the content hash of every artifact, each checked against its files."""
    found = {}
    for path in (house.folder / "build").rglob(artifact.MANIFEST):
        if path.parent.name.startswith("."):  # of one that died just before the rename: it does not count
            continue
        manifest = artifact.read_manifest(path.parent)
        assert manifest is not None, path
        assert manifest.files == artifact.digests(path.parent), path
        found[path.parent.relative_to(house.folder).as_posix()] = (manifest.content, manifest.key)
    return found


def leftovers(house):
    return [p for pattern in (".*.tmp*", ".*.old*") for p in (house.folder / "build").rglob(pattern)]


@pytest.mark.slow
def test_a_second_build_does_nothing(house):
    assert begun(house.make("toy")) == set()


def test_touching_reruns_nothing(house):
    for path in (house.folder / "build/toy/plan/keys").iterdir():
        path.touch()
    assert begun(house.make("toy")) == set()


FUTURE_NS = time.time_ns() + 10**9 * 3600 * 24 * 365


@pytest.mark.slow
def test_stamps_from_the_future_hide_nothing(house):
    """The clock was a year ahead when it was built, or the stamps were copied from where it was."""
    for stamp in (house.folder / "build/toy").rglob(artifact.STAMP):
        os.utime(stamp, ns=(FUTURE_NS, FUTURE_NS))
    house.write("agents/toy.toml", "[train_behavior]\nseed = 5\n")
    assert begun(house.make("toy")) == {"behavior", "simulator", "evaluation", "report"}
    assert begun(house.make("toy")) == set()


@pytest.mark.slow
def test_a_clock_that_goes_back_hides_nothing(house):
    """All was stamped by a clock that was a year ahead; it is put right while a build runs."""
    os.utime(house.folder / "build/toy/clock", ns=(FUTURE_NS, FUTURE_NS))
    for stamp in (house.folder / "build/toy").rglob(artifact.STAMP):
        os.utime(stamp, ns=(FUTURE_NS - 1000, FUTURE_NS - 1000))
    assert begun(house.make("toy")) == set()
    front = house.folder / "stages/estimate_flow/__main__.py"
    front.write_text(front.read_text().replace("* 64", "* 65"))
    assert {"flow.v001", "registration", "behavior", "report"} <= begun(house.make("-j2", "toy"))
    assert begun(house.make("toy")) == set()


def test_a_key_that_changes_while_its_job_runs_is_not_stamped(house):
    house.write("agents/toy.toml", "[train_behavior]\npause_s = 1.0\n")
    house.python("pipeline.workflow.plan", "plan", "toy")
    command = [sys.executable, "-SE", "-m", "pipeline.workflow.run", "toy", "behavior"]
    running = subprocess.Popen(command, cwd=house.folder, stderr=subprocess.PIPE, text=True)
    while not leftovers(house) and running.poll() is None:
        time.sleep(0.02)
    house.write("agents/toy.toml", "[train_behavior]\nseed = 5\n")
    house.python("pipeline.workflow.plan", "plan", "toy")
    assert running.communicate(timeout=60)[1].count("] begins (") == 2
    assert running.returncode == 0
    assert begun(house.make("toy")) == {"simulator", "evaluation", "report"}


def test_a_changed_table_reruns_that_stage_and_what_depends_on_it(house):
    house.write("agents/toy.toml", "[train_behavior]\nseed = 5\n")
    assert begun(house.make("toy")) == {"behavior", "simulator", "evaluation", "report"}


@pytest.mark.slow
def test_equal_results_cut_the_work_off(house):
    """`pause_s` changes the key of the flow but not its content."""
    front = house.folder / "stages/estimate_flow/__main__.py"
    front.write_text(front.read_text() + "\nNOTHING = 0\n")
    assert begun(house.make("toy")) == {"flow.v001", "flow.v002", "flow.v003"}


@pytest.mark.slow
def test_redo(house):
    assert begun(house.make("toy.masks.redo")) == {"masks.v001", "masks.v002", "masks.v003"}
    assert begun(house.make("toy")) == set()


@pytest.mark.slow
def test_a_record_cut_off_is_cleaned_up(house):
    """The writer died when its artifact was published and not yet stamped: nothing is made again."""
    (house.folder / "build/toy/records/.flow.v001.json.tmp").touch()
    (house.folder / "build/toy/flow/v001" / artifact.STAMP).unlink()
    assert begun(house.make("toy")) == set()
    assert not leftovers(house)


@pytest.mark.slow
def test_up_to_one_artifact(house):
    shutil.rmtree(house.folder / "build")
    assert begun(house.make("toy.flow")) == {
        "synthetic_capture",
        *(f"frames.v00{i}" for i in (1, 2, 3)),
        *(f"flow.v00{i}" for i in (1, 2, 3)),
    }


def test_a_variant_shares_what_it_does_not_touch(house):
    before = contents(house)
    assert begun(house.make("toy", "VARIANT=other")) == {"behavior", "simulator", "evaluation", "report"}
    assert contents(house).items() >= before.items()
    assert begun(house.make("toy")) == set()


def test_a_failing_stage_keeps_the_old_result_and_its_code(house):
    before = contents(house)
    house.write("agents/toy.toml", "[train_behavior]\nfail = true\n")
    house.python("pipeline.workflow.plan", "plan", "toy")
    failed = house.python("pipeline.workflow.run", "toy", "behavior")
    assert failed.returncode == 2
    assert "TST-001" in failed.stderr
    assert contents(house) == before
    assert not leftovers(house)


def test_a_damaged_input_is_named_when_a_stage_fails(house):
    house.write("agents/toy.toml", "[train_behavior]\nfail = true\n")
    data = house.folder / "build/toy/behavior_data"
    (data / "1.bin").write_bytes(b"cut")
    failed = house.make("toy.behavior")
    assert failed.returncode == 2
    assert "error: ART-005 build/toy/behavior_data/1.bin" in failed.stderr
    assert "rm -r build/toy/behavior_data" in failed.stderr


@pytest.mark.slow
def test_what_changed_behind_a_builds_back_is_found(house):
    assert house.make("verify", "AGENT=toy").returncode == 0
    changed = house.folder / "build/toy/flow/v001/1.bin"
    before = changed.stat()
    changed.write_bytes(changed.read_bytes()[::-1])
    os.utime(changed, ns=(before.st_atime_ns, before.st_mtime_ns))
    found = house.make("verify", "AGENT=toy")
    assert found.returncode == 2
    assert [line for line in found.stderr.splitlines() if line.startswith("error: ")] == [
        "error: ART-005 build/toy/flow/v001/1.bin: has been damaged, changed or deleted since it was made"
    ]
    shutil.rmtree(house.folder / "build/toy/flow/v001")
    assert begun(house.make("toy")) == {"flow.v001"}
    assert house.make("verify", "AGENT=toy").returncode == 0


def test_an_unfinished_input_is_named(house):
    (house.folder / "build/toy/reconstruction/manifest.json").unlink()
    refused = house.python("pipeline.workflow.run", "toy", "splats")
    assert refused.returncode == 2
    assert refused.stderr.startswith("error: ART-001 build/toy/reconstruction")


def test_an_unknown_job_is_named(house):
    assert house.python("pipeline.workflow.run", "toy", "nothing").stderr.startswith("error: RUN-001 toy")


@pytest.mark.slow
def test_a_removed_recording_reruns_the_merge(tmp_path):
    house = checkout.create(tmp_path)
    for name in ("walkthrough", "turnaround", "a", "b", "c"):
        house.write(f"captures/toy/{name}.r3d", name)
    begun(house.make("-j2", "toy.registration"))
    (house.folder / "captures/toy/a.r3d").unlink()
    again = begun(house.make("-j2", "toy.registration"))
    assert {"registration", "feature_basis"} <= again
    assert not again & {"frames.v003", "flow.v003", "masks.v003"}


@pytest.mark.slow
def test_two_builds_at_once_are_both_right(house):
    reference = contents(house)
    shutil.rmtree(house.folder / "build")
    command = ["make", f"PYTHON={sys.executable}", "-j2", "toy"]
    both = [
        subprocess.Popen(command, cwd=house.folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for _ in range(2)
    ]
    assert [each.wait() for each in both] == [0, 0]
    assert contents(house) == reference


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["group", "anyone"])
def test_kills_leave_nothing_wrong(house, victim):
    """SIGKILL at random points; whatever counts as complete is, and the next build ends as if nothing had
    been.
    """
    reference = contents(house)
    choice = random.Random(victim)
    shutil.rmtree(house.folder / "build")
    for complete in sorted(choice.sample(range(len(reference) - 5), 2)):
        command = ["make", f"PYTHON={sys.executable}", "-j2", "toy"]
        build = subprocess.Popen(
            command,
            cwd=house.folder,
            start_new_session=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        while (
            build.poll() is None
            and sum(artifact.MANIFEST in files for *_, files in os.walk(house.folder / "build")) < complete
        ):
            time.sleep(choice.uniform(0.0, 0.1))
        match victim:
            case "group":
                os.killpg(build.pid, signal.SIGKILL)
            case "anyone":
                alive = checkout.alive_of_group(build.pid)
                os.kill(choice.choice(alive), signal.SIGKILL)
        build.wait()
        checkout.wait_for_group(build.pid)
        done = contents(house)
        assert done.items() <= reference.items()
    assert house.make("-j2", "toy").returncode == 0
    assert contents(house) == reference
    assert not leftovers(house)


def test_a_job_that_is_told_to_stop_ends_with_its_stage(house):
    house.write("agents/toy.toml", "[synthesize_capture]\npause_s = 60.0\n")
    assert house.python("pipeline.workflow.plan", "plan", "toy").returncode == 0
    command = [sys.executable, "-SE", "-m", "pipeline.workflow.run", "toy", "synthetic_capture"]
    running = subprocess.Popen(command, cwd=house.folder, stderr=subprocess.PIPE, text=True)
    while not leftovers(house) and running.poll() is None:
        time.sleep(0.02)
    running.send_signal(signal.SIGTERM)
    told = running.communicate(timeout=run.GRACE_S - 5)[1]
    assert (running.returncode, told.count("run the same again to go on")) == (128 + signal.SIGTERM, 1)


def test_snakemake_finds_makes_results_up_to_date(house):
    command = [sys.executable, "-m", "snakemake", "--cores", "2", "--config", "agent=toy"]
    told = subprocess.run(command, cwd=house.folder, capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    assert "Nothing to be done" in told.stdout + told.stderr


@pytest.mark.slow
def test_snakemake_builds_the_same(house):
    reference = contents(house)
    shutil.rmtree(house.folder / "build")
    command = [sys.executable, "-m", "snakemake", "--cores", "2", "--config", "agent=toy"]
    told = subprocess.run(command, cwd=house.folder, capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    assert contents(house) == reference
    assert begun(house.make("toy")) == set()


def test_another_attempt_does_not_repeat_what_cannot_end_otherwise(house):
    house.write("agents/toy.toml", "[train_behavior]\nfail = true\n")
    house.python("pipeline.workflow.plan", "plan", "toy")
    again = ("pipeline.workflow.run", "--attempt", "2", "toy", "behavior")
    assert "TST-001" in house.python(*again).stderr  # nothing is known of an earlier attempt
    refused = house.python(*again)
    assert refused.returncode == 2
    assert "not tried again: it ended with exit code 2" in refused.stderr
    assert (
        "TST-001" in house.python("pipeline.workflow.run", "toy", "behavior").stderr
    )  # the user tries again
    house.write("agents/toy.toml", "")
    house.python("pipeline.workflow.plan", "plan", "toy")
    assert house.python(*again).returncode == 0
    house.write("agents/toy.toml", "[train_behavior]\nfail = true\n")
    house.python("pipeline.workflow.plan", "plan", "toy")
    assert "TST-001" in house.python(*again).stderr, "what failed before was forgotten by the success"


def test_every_run_of_a_job_has_its_log(house):
    logs = house.folder / "build/toy/logs"
    assert "done in" in (logs / "flow.v001.1.log").read_text()
    house.write("agents/toy.toml", "[train_behavior]\nfail = true\n")
    assert house.make("toy.behavior").returncode
    assert "TST-001" in (logs / "behavior.2.log").read_text()
    for i in range(3, 3 + run.LOGS_KEPT):
        house.python("pipeline.workflow.run", "toy", "behavior")
        assert (logs / f"behavior.{i}.log").is_file()
    assert len(list(logs.glob("behavior.*.log"))) == run.LOGS_KEPT


@pytest.mark.parametrize("text", ["", "{", '[\n{"id": "behavior", "x": ' + "[" * 5000])
def test_a_broken_plan_is_refused(house, text):
    (house.folder / "build/toy/plan/dag.json").write_text(text)
    failed = house.python("pipeline.workflow.run", "toy", "behavior")
    assert failed.returncode == 2
    assert failed.stderr.startswith("error: RUN-001")


PROCESSES_MEET = """
import os, time
from pathlib import Path


def run(inputs, config, out):
    meeting = Path("meeting")
    meeting.mkdir(exist_ok=True)
    rank, size = os.environ["RANK"], int(os.environ["WORLD_SIZE"])
    (meeting / rank).touch()
    while len(list(meeting.iterdir())) < size:
        time.sleep(0.05)
    (out / "0.bin").write_text(f"{size} processes, {os.environ['GROUP_WORLD_SIZE']} machines")


if __name__ == "__main__":
    cli.main(__doc__, run, Inputs, Config)
"""


@pytest.mark.slow
@pytest.mark.parametrize("machines", [1, 2])
def test_processes_of_one_and_two_machines_meet(house, monkeypatch, machines):
    front = house.folder / "stages/reconstruct/__main__.py"
    head, _, _ = front.read_text().partition("def run(")
    front.write_text(head + PROCESSES_MEET)
    house.python("pipeline.workflow.plan", "plan", "toy")
    options = ["--processes", "2"]
    if machines == 2:  # the launcher starts torchrun twice on this machine, as srun does on two
        house.write("launch", '#!/bin/sh\nPET_NODE_RANK=0 "$@" & PET_NODE_RANK=1 "$@" & wait %1 && wait %2\n')
        (house.folder / "launch").chmod(0o755)
        with socket.create_server(("127.0.0.1", 0)) as server:
            port = server.getsockname()[1]
        monkeypatch.setenv("PET_NNODES", "2")
        monkeypatch.setenv("PET_RDZV_BACKEND", "static")
        monkeypatch.setenv("PET_MASTER_ADDR", "127.0.0.1")
        monkeypatch.setenv("PET_MASTER_PORT", str(port))
        options += ["--launcher", "./launch"]
    made = house.python("pipeline.workflow.run", *options, "toy", "reconstruction")
    assert made.returncode == 0, made.stderr
    text = (house.folder / "build/toy/reconstruction/0.bin").read_text()
    assert text == f"{2 * machines} processes, {machines} machines"
