"""The runner and its engines: cut-off, redo, variants, failures, kills; Make and Snakemake agree."""

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
    small_checkout = checkout.create(tmp_path_factory.mktemp("checkout"))
    made = small_checkout.make("-j2", "toy")
    assert made.returncode == 0, made.stderr
    return small_checkout


@pytest.fixture
def small_checkout(built, tmp_path):
    """A copy of the built checkout with its modification times."""
    shutil.copytree(built.folder, tmp_path / "checkout", symlinks=True)
    return checkout.Checkout(tmp_path / "checkout")


def started_jobs(made):
    assert made.returncode == 0, made.stderr
    return {line.split("]")[0][1:] for line in made.stderr.splitlines() if "] begins (" in line}


def contents(small_checkout):
    """Return the content hash of every artifact, each checked against its files."""
    found = {}
    for path in (small_checkout.folder / "build").rglob(artifact.MANIFEST):
        if path.parent.name.startswith("."):  # of a writer that was killed before the rename: ignored
            continue
        manifest = artifact.read_manifest(path.parent)
        assert manifest is not None, path
        assert manifest.files == artifact.digests(path.parent), path
        found[path.parent.relative_to(small_checkout.folder).as_posix()] = (manifest.content, manifest.key)
    return found


def leftovers(small_checkout):
    return [p for pattern in (".*.tmp*", ".*.old*") for p in (small_checkout.folder / "build").rglob(pattern)]


def begun(small_checkout, job):
    """Run a job, and return its process once its stage writes."""
    command = [sys.executable, "-SE", "-m", "pipeline.workflow.run", "toy", job]
    running = subprocess.Popen(command, cwd=small_checkout.folder, stderr=subprocess.PIPE, text=True)
    while not leftovers(small_checkout) and running.poll() is None:
        time.sleep(0.02)
    return running


def building(small_checkout):
    """Start `make` in a process group of its own."""
    command = ["make", f"PYTHON={sys.executable}", "-j2", "toy"]
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(command, cwd=small_checkout.folder, start_new_session=True, **silent)


@pytest.mark.slow
def test_second_build_runs_no_job(small_checkout):
    assert started_jobs(small_checkout.make("toy")) == set()


def test_touched_files_rerun_no_job(small_checkout):
    for path in (small_checkout.folder / "build/toy/plan/keys").iterdir():
        path.touch()
    assert started_jobs(small_checkout.make("toy")) == set()


FUTURE_NS = time.time_ns() + 10**9 * 3600 * 24 * 365


@pytest.mark.slow
def test_changes_are_detected_with_future_stamps(small_checkout):
    """The clock was a year ahead during the build, or stamps were copied from another machine."""
    for stamp in (small_checkout.folder / "build/toy").rglob(artifact.STAMP):
        os.utime(stamp, ns=(FUTURE_NS, FUTURE_NS))
    small_checkout.write("agents/toy.toml", "[train_behavior]\nseed = 5\n")
    assert started_jobs(small_checkout.make("toy")) == {"behavior", "simulator", "evaluation", "report"}
    assert started_jobs(small_checkout.make("toy")) == set()


@pytest.mark.slow
def test_changes_are_detected_when_the_clock_is_set_back(small_checkout):
    """All stamps were written with a clock a year ahead, which is corrected during a build."""
    os.utime(small_checkout.folder / "build/toy/clock", ns=(FUTURE_NS, FUTURE_NS))
    for stamp in (small_checkout.folder / "build/toy").rglob(artifact.STAMP):
        os.utime(stamp, ns=(FUTURE_NS - 1000, FUTURE_NS - 1000))
    assert started_jobs(small_checkout.make("toy")) == set()
    front = small_checkout.folder / "stages/estimate_flow/__main__.py"
    front.write_text(front.read_text().replace("* 64", "* 65"))
    assert {"flow.v001", "registration", "behavior", "report"} <= started_jobs(
        small_checkout.make("-j2", "toy")
    )
    assert started_jobs(small_checkout.make("toy")) == set()


def test_key_that_changes_during_its_job_is_not_stamped(small_checkout):
    small_checkout.write("agents/toy.toml", "[train_behavior]\npause_s = 1.0\n")
    small_checkout.plan()
    running = begun(small_checkout, "behavior")
    small_checkout.write("agents/toy.toml", "[train_behavior]\nseed = 5\n")
    small_checkout.plan()
    assert running.communicate(timeout=60)[1].count("] begins (") == 2
    assert running.returncode == 0
    assert started_jobs(small_checkout.make("toy")) == {"simulator", "evaluation", "report"}


def test_changed_recipe_table_reruns_its_stage_and_dependents(small_checkout):
    small_checkout.write("agents/toy.toml", "[train_behavior]\nseed = 5\n")
    assert started_jobs(small_checkout.make("toy")) == {"behavior", "simulator", "evaluation", "report"}


@pytest.mark.slow
def test_equal_results_do_not_rerun_dependents(small_checkout):
    """`pause_s` changes the key of the flow but not its content."""
    front = small_checkout.folder / "stages/estimate_flow/__main__.py"
    front.write_text(front.read_text() + "\nNOTHING = 0\n")
    assert started_jobs(small_checkout.make("toy")) == {"flow.v001", "flow.v002", "flow.v003"}


@pytest.mark.slow
def test_redo_reruns_the_job(small_checkout):
    assert started_jobs(small_checkout.make("toy.masks.redo")) == {"masks.v001", "masks.v002", "masks.v003"}
    assert started_jobs(small_checkout.make("toy")) == set()


@pytest.mark.slow
def test_job_killed_before_its_stamp_is_not_rerun(small_checkout):
    """The writer was killed after publishing and before stamping: nothing is rebuilt."""
    (small_checkout.folder / "build/toy/records/.flow.v001.json.tmp").touch()
    (small_checkout.folder / "build/toy/flow/v001" / artifact.STAMP).unlink()
    assert started_jobs(small_checkout.make("toy")) == set()
    assert not leftovers(small_checkout)


@pytest.mark.slow
def test_build_up_to_one_artifact(small_checkout):
    shutil.rmtree(small_checkout.folder / "build")
    assert started_jobs(small_checkout.make("toy.flow")) == {
        "synthetic_capture",
        *(f"frames.v00{i}" for i in (1, 2, 3)),
        *(f"flow.v00{i}" for i in (1, 2, 3)),
    }


def test_variant_shares_unaffected_artifacts(small_checkout):
    before = contents(small_checkout)
    assert started_jobs(small_checkout.make("toy", "VARIANT=other")) == {
        "behavior",
        "simulator",
        "evaluation",
        "report",
    }
    assert contents(small_checkout).items() >= before.items()
    assert started_jobs(small_checkout.make("toy")) == set()


def test_failing_stage_keeps_the_old_artifact_and_its_exit_code(small_checkout):
    before = contents(small_checkout)
    small_checkout.write("agents/toy.toml", "[train_behavior]\nfail = true\n")
    small_checkout.plan()
    failed = small_checkout.python("pipeline.workflow.run", "toy", "behavior")
    assert failed.returncode == 2
    assert "TST-001" in failed.stderr
    assert contents(small_checkout) == before
    assert not leftovers(small_checkout)


def test_damaged_input_of_a_failed_stage_is_named(small_checkout):
    small_checkout.write("agents/toy.toml", "[train_behavior]\nfail = true\n")
    data = small_checkout.folder / "build/toy/behavior_data"
    (data / "1.bin").write_bytes(b"cut")
    failed = small_checkout.make("toy.behavior")
    assert failed.returncode == 2
    assert "error: ART-005 build/toy/behavior_data/1.bin" in failed.stderr
    assert "rm -r build/toy/behavior_data" in failed.stderr


@pytest.mark.slow
def test_verify_finds_modified_files(small_checkout):
    assert small_checkout.make("verify", "AGENT=toy").returncode == 0
    changed = small_checkout.folder / "build/toy/flow/v001/1.bin"
    before = changed.stat()
    changed.write_bytes(changed.read_bytes()[::-1])
    os.utime(changed, ns=(before.st_atime_ns, before.st_mtime_ns))
    found = small_checkout.make("verify", "AGENT=toy")
    assert found.returncode == 2
    assert [line for line in found.stderr.splitlines() if line.startswith("error: ")] == [
        "error: ART-005 build/toy/flow/v001/1.bin: has been damaged, changed or deleted since it was made"
    ]
    shutil.rmtree(small_checkout.folder / "build/toy/flow/v001")
    assert started_jobs(small_checkout.make("toy")) == {"flow.v001"}
    assert small_checkout.make("verify", "AGENT=toy").returncode == 0


def test_incomplete_input_is_named(small_checkout):
    (small_checkout.folder / "build/toy/reconstruction/manifest.json").unlink()
    refused = small_checkout.python("pipeline.workflow.run", "toy", "splats")
    assert refused.returncode == 2
    assert refused.stderr.startswith("error: ART-001 build/toy/reconstruction")


def test_unknown_job_is_named(small_checkout):
    assert small_checkout.python("pipeline.workflow.run", "toy", "nothing").stderr.startswith(
        "error: RUN-001 toy"
    )


@pytest.mark.slow
def test_removed_recording_reruns_the_merge(tmp_path):
    small_checkout = checkout.create(tmp_path)
    for name in ("walkthrough", "turnaround", "a", "b", "c"):
        small_checkout.write(f"captures/toy/{name}.r3d", name)
    started_jobs(small_checkout.make("-j2", "toy.registration"))
    (small_checkout.folder / "captures/toy/a.r3d").unlink()
    again = started_jobs(small_checkout.make("-j2", "toy.registration"))
    assert {"registration", "feature_basis"} <= again
    assert not again & {"frames.v003", "flow.v003", "masks.v003"}


@pytest.mark.slow
def test_concurrent_builds_are_correct(small_checkout):
    reference = contents(small_checkout)
    shutil.rmtree(small_checkout.folder / "build")
    both = [building(small_checkout) for _ in range(2)]
    assert [each.wait() for each in both] == [0, 0]
    assert contents(small_checkout) == reference


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["group", "anyone"])
def test_builds_recover_from_kills(small_checkout, victim):
    """SIGKILL at random points: complete artifacts are correct, and the next build succeeds."""
    reference = contents(small_checkout)
    choice = random.Random(victim)
    shutil.rmtree(small_checkout.folder / "build")
    for complete in sorted(choice.sample(range(len(reference) - 5), 2)):
        build = building(small_checkout)
        while (
            build.poll() is None
            and sum(artifact.MANIFEST in files for *_, files in os.walk(small_checkout.folder / "build"))
            < complete
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
        done = contents(small_checkout)
        assert done.items() <= reference.items()
    assert small_checkout.make("-j2", "toy").returncode == 0
    assert contents(small_checkout) == reference
    assert not leftovers(small_checkout)


def test_terminated_job_ends_its_stage(small_checkout):
    small_checkout.write("agents/toy.toml", "[synthesize_capture]\npause_s = 60.0\n")
    assert small_checkout.plan().returncode == 0
    running = begun(small_checkout, "synthetic_capture")
    running.send_signal(signal.SIGTERM)
    completed = running.communicate(timeout=run.GRACE_S - 5)[1]
    assert (running.returncode, completed.count("run the same again to go on")) == (128 + signal.SIGTERM, 1)


def test_stage_ends_although_nobody_reads_its_output(small_checkout):
    """As `make toy 2>&1 | less` after `q`: the stage prints more than a pipe holds, and its log has it all."""
    program = small_checkout.folder / "stages/synthesize_capture/__main__.py"
    loud = "run(inputs, config, out):\n    print('one line more\\n' * 50_000)"
    program.write_text(program.read_text().replace("run(inputs, config, out):", loud))
    assert small_checkout.plan().returncode == 0
    command = [sys.executable, "-SE", "-m", "pipeline.workflow.run", "toy", "synthetic_capture"]
    running = subprocess.Popen(command, cwd=small_checkout.folder, stderr=subprocess.PIPE)
    assert running.stderr is not None and b"begins" in running.stderr.readline()
    running.stderr.close()
    try:
        assert running.wait(timeout=30) == 0
    finally:
        running.kill()
    log = (small_checkout.folder / "build/toy/logs/synthetic_capture.2.log").read_text()
    assert log.count("one line more") == 50_000 and "done in" in log
    assert (small_checkout.folder / "build/toy/synthetic_capture/.ok").exists()


def test_snakemake_accepts_results_of_make(small_checkout):
    completed = small_checkout.snakemake("--cores", "2", "--config", "agent=toy")
    assert completed.returncode == 0, completed.stderr
    assert "Nothing to be done" in completed.stdout + completed.stderr


@pytest.mark.slow
def test_snakemake_and_make_give_the_same_artifacts(small_checkout):
    reference = contents(small_checkout)
    shutil.rmtree(small_checkout.folder / "build")
    completed = small_checkout.snakemake("--cores", "2", "--config", "agent=toy")
    assert completed.returncode == 0, completed.stderr
    assert contents(small_checkout) == reference
    assert started_jobs(small_checkout.make("toy")) == set()


def test_deterministic_failures_are_not_retried(small_checkout):
    small_checkout.write("agents/toy.toml", "[train_behavior]\nfail = true\n")
    small_checkout.plan()
    again = ("pipeline.workflow.run", "--attempt", "2", "toy", "behavior")
    assert "TST-001" in small_checkout.python(*again).stderr  # no record of an earlier attempt
    refused = small_checkout.python(*again)
    assert refused.returncode == 2
    assert "not tried again: it ended with exit code 2" in refused.stderr
    assert (
        "TST-001" in small_checkout.python("pipeline.workflow.run", "toy", "behavior").stderr
    )  # the user retries
    small_checkout.write("agents/toy.toml", "")
    small_checkout.plan()
    assert small_checkout.python(*again).returncode == 0
    small_checkout.write("agents/toy.toml", "[train_behavior]\nfail = true\n")
    small_checkout.plan()
    assert "TST-001" in small_checkout.python(*again).stderr, (
        "what failed before was forgotten by the success"
    )


def test_every_run_of_a_job_has_a_log(small_checkout):
    logs = small_checkout.folder / "build/toy/logs"
    assert "done in" in (logs / "flow.v001.1.log").read_text()
    small_checkout.write("agents/toy.toml", "[train_behavior]\nfail = true\n")
    assert small_checkout.make("toy.behavior").returncode
    assert "TST-001" in (logs / "behavior.2.log").read_text()
    for i in range(3, 3 + run.LOGS_KEPT):
        small_checkout.python("pipeline.workflow.run", "toy", "behavior")
        assert (logs / f"behavior.{i}.log").is_file()
    assert len(list(logs.glob("behavior.*.log"))) == run.LOGS_KEPT


@pytest.mark.parametrize("text", ["", "{", '[\n{"id": "behavior", "x": ' + "[" * 5000])
def test_damaged_plan_is_refused(small_checkout, text):
    (small_checkout.folder / "build/toy/plan/dag.json").write_text(text)
    failed = small_checkout.python("pipeline.workflow.run", "toy", "behavior")
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
def test_processes_of_one_and_two_machines_connect(small_checkout, monkeypatch, machines):
    front = small_checkout.folder / "stages/reconstruct/__main__.py"
    head, _, _ = front.read_text().partition("def run(")
    front.write_text(head + PROCESSES_MEET)
    small_checkout.plan()
    options = ["--processes", "2"]
    if machines == 2:  # the launcher starts torchrun twice on this machine, as srun does on two
        small_checkout.write(
            "launch", '#!/bin/sh\nPET_NODE_RANK=0 "$@" & PET_NODE_RANK=1 "$@" & wait %1 && wait %2\n'
        )
        (small_checkout.folder / "launch").chmod(0o755)
        with socket.create_server(("127.0.0.1", 0)) as server:
            port = server.getsockname()[1]
        monkeypatch.setenv("PET_NNODES", "2")
        monkeypatch.setenv("PET_RDZV_BACKEND", "static")
        monkeypatch.setenv("PET_MASTER_ADDR", "127.0.0.1")
        monkeypatch.setenv("PET_MASTER_PORT", str(port))
        options += ["--launcher", "./launch"]
    made = small_checkout.python("pipeline.workflow.run", *options, "toy", "reconstruction")
    assert made.returncode == 0, made.stderr
    text = (small_checkout.folder / "build/toy/reconstruction/0.bin").read_text()
    assert text == f"{2 * machines} processes, {machines} machines"
