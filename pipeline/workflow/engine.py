"""What the Snakefile needs of the DAG: homes, targets, and the inputs and resources of each rule.

The process that the user starts writes the plan; jobs elsewhere only read their line of it. Standard
library only.
"""

import csv
import functools
import math
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.core.config import refuse_unknown
from pipeline.core.errors import InputError
from pipeline.workflow import artifact, dag, jobs

FRAMES_UNKNOWN = 1000
"""Assumed number of frames of a recording before extraction: 100 s at 10 Hz."""
MIN_RUNTIME_MIN = 60
"""Minimum time limit of a job on its first attempt, minutes."""
RUNTIME_FACTOR = 4
"""How much slower than the measured machine a compute node may be."""
MEMORY_MB = 3000
"""Memory that every job reserves on its first attempt; not a limit."""
MEMORY_GROWTH = 1.5
"""Memory of each attempt, relative to the one before."""
_known: dict[tuple[str, str], dict[str, Any]] = {}
"""Cache of planned jobs, by home and id."""
OPTIONS = ("agent", "agents", "homes", "variant", "gpu", "processes", "launcher", "container")
HOME = r"[a-z0-9][a-z0-9_-]*(?:/(?:variants|animals)/[a-z0-9][a-z0-9_-]*)?"
"""Pattern of the homes in a rule's output."""


def homes(config: Mapping[str, Any]) -> list[str]:
    """Return the homes to build: `agents=[...]`, a table `homes=` (agent, variant), or one `agent=`."""
    refuse_unknown(config, OPTIONS, where="snakemake --config")
    variant = config.get("variant")
    if config.get("homes"):
        path = Path(config["homes"])
        try:
            with path.open(newline="", encoding="utf-8-sig") as file:
                rows = list(csv.DictReader(file, delimiter="\t"))
            named = [(row["agent"], row.get("variant") or variant) for row in rows]
            if not named:
                raise csv.Error("it has no rows")
        except (OSError, UnicodeDecodeError, KeyError, csv.Error) as error:
            remedy = "write a tab-separated table with a column `agent` and, if needed, `variant`"
            raise InputError("REC-003", f"is no list of homes: {error}", str(path), remedy) from error
    else:
        agents = config.get("agents") or [config.get("agent", "cat")]
        named = [(agent, variant) for agent in ([agents] if isinstance(agents, str) else agents)]
    found = [f"{agent}/variants/{variant}" if variant else str(agent) for agent, variant in named]
    return [str(jobs.Home.parse(home)) for home in found]


def plan(homes: list[str]) -> None:
    """Bring the plans of all homes up to date, in one process."""
    command = [sys.executable, "-SE", "-m", "pipeline.workflow.plan", "plan", *homes]
    subprocess.run(command, check=True, stdout=sys.stderr)


def targets(homes: list[str]) -> list[str]:
    """Return the stamps that a build of these homes requests: those that no other of its jobs depends on."""
    wanted: dict[str, None] = {}
    for home in map(jobs.Home.parse, homes):
        for job in jobs.read_jobs(home):
            _known[job["home"], job["id"]] = job
            wanted |= {} if job["on_demand"] else {job["stamp"]: None}
    dependencies = {each for job in _known.values() if job["stamp"] in wanted for each in job["after"]}
    return [stamp for stamp in wanted if stamp not in dependencies]


def output(node: dag.Node) -> str:
    """Return the stamp of a node's jobs, as a pattern."""
    return f"build/{{home}}/{node.artifact}/{'{part}/' if node.several else ''}{artifact.STAMP}"


def job_pattern(node: dag.Node) -> str:
    """Return the id of a node's jobs, as a pattern."""
    return f"{node.artifact}.{{part}}" if node.several else node.artifact


def inputs(node: dag.Node, wildcards: Any) -> list[str]:
    """Return the stamps that a node's job depends on."""
    return _job(wildcards.home, _id(node, wildcards))["after"]


def memory_mb(node: dag.Node, wildcards: Any, attempt: int) -> int:
    """Return the memory that a node's job reserves."""
    frames = _frames(wildcards.home, _id(node, wildcards)) if node.memory_mb_per_1000_frames else 0
    needed = MEMORY_MB + node.memory_mb_per_1000_frames * frames / 1000
    return math.ceil(needed * MEMORY_GROWTH ** (attempt - 1))


def runtime_min(node: dag.Node, wildcards: Any, attempt: int) -> int:
    """Return the time limit of a node's job, minutes."""
    seconds = RUNTIME_FACTOR * node.seconds_per_frame * _frames(wildcards.home, _id(node, wildcards))
    return math.ceil((MIN_RUNTIME_MIN + seconds / 60) * attempt)


def _id(node: dag.Node, wildcards: Any) -> str:
    return job_pattern(node).replace("{part}", getattr(wildcards, "part", ""))


def _job(home: str, id: str) -> dict[str, Any]:
    if (home, id) not in _known:
        _known[home, id] = jobs.read_job(jobs.Home.parse(home), id)
    return _known[home, id]


@functools.cache
def _frames(home: str, id: str) -> int:
    """Return the number of frames that a job reads; estimated for recordings not extracted yet."""
    folders = [each["path"] for each in _job(home, id)["inputs"] if each["name"].startswith("frames/")]
    return sum(map(_frames_in, folders)) or FRAMES_UNKNOWN


@functools.cache
def _frames_in(folder: str) -> int:
    try:
        return len(os.listdir(f"{folder}/color"))
    except FileNotFoundError:
        return FRAMES_UNKNOWN
