"""The runner, called by engines: run one job so that its artifact is complete or absent.

    python -SE -m pipeline.workflow.run [OPTIONS] HOME JOB      for example `toy masks.v002`

lock -> remove leftovers of killed runs -> key -> unchanged? stamp -> run the stage program, which publishes
atomically -> record -> stamp -> key changed meanwhile? once more. Exit codes: the stage's own (2 bad input,
75 stopped but resumable, 76 diverged), 128 + n when signal n ended it. --processes: as many per machine fit
one model together (torchrun); across machines --launcher starts torchrun on each, for example
`srun --ntasks-per-node=1`, and torchrun's own variables (PET_NNODES, PET_RDZV_ENDPOINT ...) say how they
meet. --attempt: of an engine that tries again; above 1, a job that ended with 2 or 76 and has the same key is
not run. What a job printed stands in build/<home>/logs/<job>.<number>.log. Standard library only.
"""

import contextlib
import json
import os
import platform
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from resource import struct_rusage
from types import FrameType
from typing import Any, TextIO

from pipeline.core import processes
from pipeline.core.errors import CommandLine, InputError, coded_disk_errors, exit_code, printable
from pipeline.workflow import artifact, jobs, sources, stamps

MIN_FREE_BYTES = 1 << 29
"""Free disk space below which no stage is started."""
LONGEST_S = 7 * 24 * 3600
"""Time limit of a stage: one that takes longer hangs."""
GRACE_S = 30
"""Time that a stage has to save a checkpoint after SIGTERM."""
FINAL_CODES = (2, 76)
"""Bad input and divergence: deterministic failures as long as the key is the same."""
LOGS_KEPT = 9
"""Number of latest logs kept per job."""
EXPLAINED = {
    75: "stopped after saving; run the same again to go on",
    76: "training diverged; its diagnosis stands above",
    **dict.fromkeys((128 + signal.SIGINT, 128 + signal.SIGTERM), "stopped; run the same again to go on"),
    128 + signal.SIGKILL: "killed; if nobody did it, memory was full: close programs, or build with -j1",
}


@dataclass(frozen=True)
class Engine:
    """How the caller runs a job."""

    processes: int = 1
    """Per machine, for distributed stages."""
    launcher: tuple[str, ...] = ()
    """Command that starts another one on every machine."""
    attempt: int = 1


def run(home: str, job_id: str, engine: Engine = Engine()) -> int:
    """Run the job if the key of its artifact has changed; return the exit code."""
    while (code := _run(home, job_id, engine)) is None:
        _say(job_id, "its key changed meanwhile: checking it again")
    return code


def _run(home: str, job_id: str, engine: Engine) -> int | None:
    """Run it once; None if its key changed while it ran, so that it has no stamp."""
    job = jobs.read_job(jobs.Home.parse(home), job_id)
    out, stamp = Path(job["out"]), Path(job["stamp"])
    resume = Path("build", job["home"], "resume", job_id)
    redo = jobs.redo_mark(job["home"], job_id)
    waiting = f"[{job_id}] is being made by another build; waiting for it"
    with artifact.locked(Path("build", job["home"], "plan", "locks", job_id), waiting):
        artifact.clean(out, _file_of(job, "records"), _file_of(job, "failures"))
        key = _key(job)
        made = artifact.read_manifest(out)
        if made is None or made.key != key or redo.exists():
            if engine.attempt > 1 and (code := _failed_before(job, key)):
                _say(job_id, f"not tried again: it ended with exit code {code}, and nothing has changed")
                return code
            mark = resume / "key"  # checkpoints of another key must never be resumed
            if redo.exists() or not mark.is_file() or mark.read_text() != key:
                shutil.rmtree(resume, ignore_errors=True)
            code = _do(job, key, resume, engine)
            if code:
                _write_json(_file_of(job, "failures"), {"key": key, "code": code})
                return code
        _file_of(job, "failures").unlink(missing_ok=True)
        redo.unlink(missing_ok=True)
        stamps.put(stamp, job["keys"])
        try:  # after the stamp: a planner reads stamps after keys
            now = _key(jobs.read_job(jobs.Home.parse(home), job_id))
        except (InputError, FileNotFoundError):  # plan or inputs have become invalid
            now = None
        if now != key:
            stamp.unlink(missing_ok=True)
            return None
        shutil.rmtree(resume, ignore_errors=True)
    return 0


def _file_of(job: dict[str, Any], kind: str) -> Path:
    return Path("build", job["home"], kind, f"{job['id']}.json")


def _failed_before(job: dict[str, Any], key: str) -> int:
    """Return the exit code of the job's last failure if it is deterministic and the key the same, else 0."""
    last = artifact.read_json(_file_of(job, "failures"))
    return last["code"] if last.get("key") == key and last["code"] in FINAL_CODES else 0


def _key(job: dict[str, Any]) -> str:
    """Hash what determines the artifact: stage, code, table, recordings, and the content of every input."""
    contents = {}
    for entry in job["inputs"]:
        manifest = artifact.opened(Path(entry["path"]), entry["name"])
        contents[entry["name"]] = manifest.content
        if part := entry["part"]:
            files = manifest.files.items()
            chosen = {name: digest for name, digest in files if f"{name}/".startswith(f"{part}/")}
            contents[entry["name"]] = artifact.digest_of(chosen)
    return artifact.digest_of([contents, [json.loads(Path(path).read_text()) for path in job["keys"]]])


def _do(job: dict[str, Any], key: str, resume: Path, engine: Engine) -> int:
    """Run the stage program with its arguments and log; return its exit code."""
    if not sources.is_stage(job["stage"]):
        what = f"there is no stage program {job['stage']!r}"
        raise InputError("RUN-002", what, "stages/", "this build is incomplete")
    free = shutil.disk_usage("build").free
    if free < MIN_FREE_BYTES:
        what, remedy = f"only {free >> 20} MB free on the disk", "free some space and run the same again"
        raise InputError("SYS-001", what, job["out"], remedy)
    arguments = [*job["arguments"], "--key", key, "--threads", str(job["threads"])]
    if job["resumable"]:
        resume.mkdir(parents=True, exist_ok=True)
        artifact.write_if_changed(resume / "key", key)
        arguments += ["--resume", str(resume)]
    with _log(job).open("w") as log:
        return _publish(job, key, [*_python(job, engine), f"stages.{job['stage']}", *arguments], log)


def _publish(job: dict[str, Any], key: str, command: list[str], log: TextIO) -> int:
    """Run the stage program and, if it succeeds, write the record of its artifact."""
    _say(job["id"], f"begins ({job['place']})", log)
    out, start = Path(job["out"]), time.time()
    code, usage = _spawn(job, command, log)
    seconds = time.time() - start
    if code:
        _say(job["id"], EXPLAINED.get(code, f"failed with exit code {code}"), log)
        if code not in EXPLAINED:
            _report_damage(job, log)
        return code
    made = artifact.read_manifest(out)
    assert made is not None and made.key == key, f"{job['stage']} ended well without writing {out}"
    record = {
        "key": key,
        "seconds": round(seconds, 2),
        "cpu_seconds": round(usage.ru_utime + usage.ru_stime, 2),
        "peak_memory_mb": round(usage.ru_maxrss / 1024),
        "threads": job["threads"],
        "host": platform.node(),
        "commit": _commit(),
        "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    _write_json(_file_of(job, "records"), record)
    _say(job["id"], f"done in {seconds:.1f} s, peak {usage.ru_maxrss / 1024:.0f} MB{_quality(out)}", log)
    return 0


def _write_json(path: Path, value: dict[str, Any]) -> None:
    artifact.write_if_changed(path, json.dumps(value, indent=1, sort_keys=True) + "\n")


def _python(job: dict[str, Any], engine: Engine) -> list[str]:
    """Return the command that runs a module: Python, or torchrun for several processes."""
    across = any(name in os.environ for name in ("PET_NNODES", "PET_RDZV_ENDPOINT"))
    if not job["distributed"] or not (engine.processes > 1 or across):
        return [sys.executable, "-m"]
    rendezvous = [] if across else ["--standalone"]
    torchrun = ["torch.distributed.run", *rendezvous, f"--nproc-per-node={engine.processes}", "-m"]
    return [*engine.launcher, sys.executable, "-m", *torchrun]


def _log(job: dict[str, Any]) -> Path:
    """Return the path of the job's next log and remove all but the latest `LOGS_KEPT`."""
    folder = Path("build", job["home"], "logs")
    folder.mkdir(parents=True, exist_ok=True)
    logs = folder.glob(f"{job['id']}.*.log")
    names = (path.name.removeprefix(f"{job['id']}.").removesuffix(".log") for path in logs)
    numbers = sorted(int(name) for name in names if name.isdigit())
    for old in numbers[: max(0, len(numbers) - LOGS_KEPT + 1)]:
        (folder / f"{job['id']}.{old}.log").unlink(missing_ok=True)
    return folder / f"{job['id']}.{(numbers or [0])[-1] + 1}.log"


def _report_damage(job: dict[str, Any], log: TextIO) -> None:
    """Report inputs that fail their checksum: a stage may have failed because of them."""
    for folder in (Path(entry["path"]) for entry in job["inputs"]):
        if changed := artifact.damaged(folder):
            what, remedy = "has been damaged, changed or deleted", f"rm -r {folder}, and run the same again"
            error = InputError("ART-005", what, str(folder / changed[0]), remedy)
            for line in f"error: {error}".splitlines():
                _say(job["id"], line, log)


def _spawn(job: dict[str, Any], command: list[str], log: TextIO) -> tuple[int, struct_rusage]:
    """Run `command`, forwarding and logging its output by line; return exit code and resource usage."""
    child = subprocess.Popen(
        command,
        env=_environment(job["threads"]),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        preexec_fn=_bind_to_parent,
    )

    def stop(number: int, frame: FrameType | None) -> None:
        child.terminate()
        killer = threading.Timer(GRACE_S, child.kill)
        killer.daemon = True  # does not delay the exit of a stage that ends in time
        killer.start()

    old = {signal.SIGTERM: signal.signal(signal.SIGTERM, stop)}
    # The child gets SIGINT itself; wait for it to save.
    old[signal.SIGINT] = signal.signal(signal.SIGINT, signal.SIG_IGN)
    reader = threading.Thread(target=_forward, args=(job["id"], child.stdout, log), daemon=True)
    reader.start()
    watchdog = threading.Timer(LONGEST_S, child.kill)
    watchdog.daemon = True
    watchdog.start()
    try:
        _, status, usage = os.wait4(child.pid, 0)
    finally:
        watchdog.cancel()
        for number, handler in old.items():
            signal.signal(number, handler)
    reader.join(timeout=2)
    code = os.waitstatus_to_exitcode(status)
    child.returncode = code
    return (128 - code if code < 0 else code), usage


def _bind_to_parent() -> None:
    """In the child: die with the runner, write no core dump."""
    processes.die_with_parent()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _environment(threads: int) -> dict[str, str]:
    """Return a stage's environment: fixed hash seed, declared threads, no busy waiting, bounded decoders."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    return {
        **os.environ,
        **dict.fromkeys(names, str(threads)),
        "OMP_WAIT_POLICY": "PASSIVE",
        "GOMP_SPINCOUNT": "0",
        "CUBLAS_WORKSPACE_CONFIG": ":4096:8",
        "OPENCV_IO_MAX_IMAGE_PIXELS": str(32 << 20),
        "PYTHONHASHSEED": "0",
        "PYTHONUNBUFFERED": "1",
    }


def _forward(job_id: str, lines: Any, log: TextIO) -> None:
    for line in lines:
        _say(job_id, printable(line.decode(errors="replace").rstrip()), log)


def _say(job_id: str, text: str, log: TextIO | None = None) -> None:
    """Print a line; where nobody reads it, or the disk is full, the stage must not wait."""
    try:
        print(f"[{job_id}] {text}", file=sys.stderr, flush=True)
    except OSError:
        sys.stderr = open(os.devnull, "w")
    with contextlib.suppress(OSError):
        if log is not None and not log.closed:
            print(text, file=log, flush=True)


def _quality(out: Path) -> str:
    """Return the artifact's own quality verdict for the last line of the log."""
    report = artifact.read_json(out / "qa.json")
    if not report:
        return ""
    warnings = []
    for check in (check for check in report["checks"] if check["status"] != "ok"):
        value = "unknown" if check["value"] is None else f"{check['value']:.3g}"
        warnings.append(f"{check['name']} {value} {check['unit']}".strip())
    return f", quality {report['status']}" + (f": {'; '.join(warnings)}" if warnings else "")


def _commit() -> str | None:
    command = ["git", "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def main(arguments: list[str]) -> int:
    """Run the command line of the runner; returns its exit code."""
    parser = CommandLine(__doc__, prog="python -m pipeline.workflow.run")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--launcher", default="")
    parser.add_argument("--attempt", type=int, default=1)
    parser.add_argument("home")
    parser.add_argument("job")
    given = parser.parse_args(arguments)
    engine = Engine(given.processes, tuple(shlex.split(given.launcher)), given.attempt)
    with coded_disk_errors(given.job):
        return run(given.home, given.job, engine)


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
