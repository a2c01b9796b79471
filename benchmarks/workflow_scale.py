"""Time planner, Make, Snakemake and the job runner on many recordings: `python -m benchmarks.workflow_scale 3000`.

Creates a checkout with empty recordings, plans it, marks everything as built, and times each engine on it. `--homes N`
times the planning of N agents of 23 recordings instead. No stage runs.
"""

import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks import command_lines

ROOT = Path(__file__).resolve().parent.parent
PER_HOME = 23
"""Recordings per agent, as of the cat in the paper."""
RUNS = 5
"""Runs of the job runner, of which the fastest is reported."""


def create_checkout(folder: Path, agents: list[str], recordings: int) -> None:
    """Link the code into `folder` and create empty recordings for every agent."""
    for name in ("pipeline", "stages", "profiles", "envs", ".venv"):
        (folder / name).symlink_to(ROOT / name)
    for name in ("Makefile", "Snakefile"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(ROOT / "agents", folder / "agents")
    for agent in agents:
        (folder / "agents" / f"{agent}.toml").write_text("")
        captures = folder / "captures" / agent
        captures.mkdir(parents=True)
        for name in ("walkthrough", "turnaround", *(f"session_{i:05d}" for i in range(recordings - 2))):
            (captures / f"{name}.r3d").touch()


@dataclass(frozen=True, order=True)
class Cost:
    """Time of a command."""

    elapsed_s: float
    cpu_s: float
    """Of all its processes; less sensitive to the load of the machine."""


def timed(folder: Path, command: list[str]) -> Cost:
    """Run a command and return its time."""
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Cost(time.perf_counter() - start, cpu_s)


def mark_built(folder: Path, agent: str) -> str:
    """Write every stamp; return the id of one job whose artifact exists and is up to date."""
    code = (
        "from pathlib import Path; from pipeline.workflow import artifact, jobs, run;"
        f"job = jobs.read_job(jobs.Home({agent!r}), 'frames.v000'); key = run._key(job)\n"
        "with artifact.create(Path(job['out']), stage='extract_frames', config={}, inputs={}, key=key) as made:\n"
        "    (made / 'x').write_text('x')\n"
    )
    timed(folder, [sys.executable, "-SE", "-c", code])
    for job in json.loads((folder / f"build/{agent}/plan/dag.json").read_text()):
        stamp = folder / job["stamp"]
        stamp.parent.mkdir(parents=True, exist_ok=True)
        stamp.touch()
    return "frames.v000"


def time_engines(folder: Path, count: int, snakemake: bool) -> dict[str, Cost]:
    """Time all engines for one agent of `count` recordings."""
    create_checkout(folder, ["many"], count)
    plan = [sys.executable, "-SE", "-m", "pipeline.workflow.plan", "plan", "many"]
    snake = [
        sys.executable,
        "-m",
        "snakemake",
        "-n",
        "--quiet",
        "rules",
        "--cores",
        "2",
        "--config",
        "agent=many",
    ]
    found = {"first plan": timed(folder, plan), "plan again": timed(folder, plan)}
    if snakemake:
        found["snakemake -n, nothing built"] = timed(folder, snake)
    job = mark_built(folder, "many")
    make = ["make", f"PYTHON={sys.executable}", "many"]
    found["make, all built"] = timed(folder, make)
    if snakemake:
        found["snakemake -n, all built"] = timed(folder, snake)
    runner = [sys.executable, "-SE", "-m", "pipeline.workflow.run", "many", job]
    found["runner, one job"] = min(timed(folder, runner) for _ in range(RUNS))
    return found


def main() -> None:
    """Measure and print the table."""
    parser = command_lines.described(__doc__)
    parser.add_argument("recordings", type=int, nargs="?", default=3000)
    parser.add_argument("--homes", type=int, help="time the planning of this many agents instead")
    parser.add_argument("--no-snakemake", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if arguments.homes:
            agents = [f"home{i:05d}" for i in range(arguments.homes)]
            create_checkout(folder, agents, PER_HOME)
            plan = [sys.executable, "-SE", "-m", "pipeline.workflow.plan", "plan", *agents]
            found = {
                f"first plan of {arguments.homes} homes": timed(folder, plan),
                "again": timed(folder, plan),
            }
        else:
            found = time_engines(folder, arguments.recordings, not arguments.no_snakemake)
    for name, cost in found.items():
        print(f"{name:32}{cost.elapsed_s:8.2f} s{cost.cpu_s:8.2f} s CPU")


if __name__ == "__main__":
    main()
