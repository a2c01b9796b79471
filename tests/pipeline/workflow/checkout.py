"""A small checkout for tests of the workflow: the real `pipeline` package, tiny stages, real recipes."""

import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from pipeline.workflow import dag

ROOT = Path(__file__).parents[3]
WITHOUT = (
    "geometry",
    "mapping",
    "data",
    "backends",
    "localization",
    "fields",
    "behavior",
    "longterm",
    "baselines",
    "metrics",
)
"""Packages that planner and runner do not need."""
SETTINGS = {
    "synthesize_capture": (
        "    session_count: int = 2\n    heldout_of: int = 1\n    foreign_sessions: int = 0\n"
        "    companion: str = 'none'\n"
    ),
    "train_localizer": "    target: str = ''\n",
    "train_behavior": "    homes: tuple[str, ...] = ()\n",
    "slice_behavior": "    others: tuple[str, ...] = ()\n",
    "export_simulator.home": "    others: tuple[str, ...] = ()\n",
    "train_longterm": '    ablations: str = "none"\n',
}
CONFIG = '''"""Settings."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    seed: int = 0
    weights: str = ""
    pause_s: float = 0.0
    fail: bool = False
{settings}'''
STAGE = '''"""Hash the inputs."""

import hashlib
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.core.errors import InputError
from pipeline.workflow import cli
from stages.{stage}.config import Config


@dataclass(frozen=True)
class Inputs:
{fields}


def run(inputs, config, out):
    digest = hashlib.sha256(repr(config).encode())
    for _, given in sorted(vars(inputs).items()):
        for path in given.values() if isinstance(given, dict) else [given] if given else []:
            files = [path] if path.is_file() else sorted(p for p in path.rglob("*.bin"))
            for file in files:
                digest.update(file.read_bytes())
    if config.fail:
        raise InputError("TST-001", "fails on request", {stage!r}, "do not")
    for i in range(3):
        (out / f"{{i}}.bin").write_bytes(digest.digest() * 64 * (i + 1))
        time.sleep(config.pause_s)
    if {stage!r} == "synthesize_capture":
        for kind in ("recordings", "truth"):
            (out / kind).mkdir()
            sessions = [f"session-{{i + 1}}" for i in range(config.session_count)]
            for name in ["walkthrough", "turnaround", *sessions, "heldout"]:
                (out / kind / f"{{name}}.r3d").write_bytes(f"{{kind}} {{name}} {{config.seed}}".encode())


if __name__ == "__main__":
    cli.main(__doc__, run, Inputs, Config)
'''


@dataclass(frozen=True)
class Checkout:
    """A working copy with tiny stages."""

    folder: Path

    def python(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a module of the checkout as Make does."""
        return subprocess.run(
            [sys.executable, "-SE", "-m", *arguments], cwd=self.folder, capture_output=True, text=True
        )

    def make(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run make."""
        command = ["make", "--no-print-directory", f"PYTHON={sys.executable}", *arguments]
        return subprocess.run(command, cwd=self.folder, capture_output=True, text=True)

    def plan(self, home: str = "toy") -> subprocess.CompletedProcess[str]:
        """Plan a home."""
        return self.python("pipeline.workflow.plan", "plan", home)

    def snakemake(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run Snakemake."""
        command = [sys.executable, "-m", "snakemake", *arguments]
        return subprocess.run(command, cwd=self.folder, capture_output=True, text=True)

    def jobs(self) -> dict[str, dict]:
        """Return the planned jobs of the toy by id."""
        planned = json.loads((self.folder / "build/toy/plan/dag.json").read_text())
        return {job["id"]: job for job in planned}

    def record(self, *names: str) -> None:
        """Write recordings of the toy; their content is their name."""
        for name in names:
            self.write(f"captures/toy/{name}", name)

    def write(self, name: str, text: str) -> None:
        """Write a file of the working copy."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def tree(self) -> dict[str, bytes]:
        """Return every file with its bytes, except caches of Python."""
        files = (
            path for path in self.folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts
        )
        return {path.relative_to(self.folder).as_posix(): path.read_bytes() for path in files}


def create(folder: Path) -> Checkout:
    """Create a working copy in `folder` with the agent `toy`."""
    shutil.copytree(
        ROOT / "pipeline", folder / "pipeline", ignore=shutil.ignore_patterns("__pycache__", *WITHOUT)
    )
    shutil.copy(ROOT / "Makefile", folder)
    shutil.copy(ROOT / "Snakefile", folder)
    shutil.copytree(ROOT / "profiles", folder / "profiles")
    made = Checkout(folder)
    for name in (
        "envs/cpu.txt",
        "envs/cuda.txt",
        "envs/setup",
        ".venv/.ok",
        "stages/__init__.py",
        "agents/toy.toml",
    ):
        made.write(name, "")
    shutil.copy(ROOT / "envs/parallel_jobs", folder / "envs")
    made.write("agents/variants/other.toml", "[train_behavior]\nseed = 7\n")
    for stage in {node.stage for node in dag.nodes_of("recordings", several=True)}:
        folder = f"stages/{stage.replace('.', '/')}"
        made.write(f"{folder}/__init__.py", "")
        made.write(f"{folder}/config.py", CONFIG.format(settings=SETTINGS.get(stage, "")))
        made.write(f"{folder}/__main__.py", STAGE.format(stage=stage, fields=_fields(stage)))
    return made


def _fields(stage: str) -> str:
    """Return the fields of `Inputs` of the stage, as declared in the flow."""
    nodes = [node for node in dag.FLOW if node.stage == stage]
    kinds = {}
    in_every = set.intersection(
        *(
            {
                need.option or need.artifact
                for need in dag.needs_of(node, "recordings")
                if not (
                    need.others or need.mapped or need.homes != "any" or dag.NODES[need.artifact].of_several
                )
            }
            for node in nodes
        )
    )
    for node in nodes:
        for need in dag.needs_of(node, "recordings"):
            one = not need.roles if node.roles else need.option
            several = (dag.NODES[need.artifact].roles and not one) or (
                dag.NODES[need.artifact].trials == "each" and node.trials != "each"
            )
            kinds[need.option or need.artifact] = "Mapping[str, Path]" if several else "Path"
            if need.others or need.homes == "other":
                kinds[need.option or need.artifact] = "Mapping[str, Path]"
            if need.variants:
                kinds["variants"] = "Mapping[str, Path]"
    required = [f"    {name}: {kind}" for name, kind in kinds.items() if name in in_every and name != "truth"]
    optional = [
        f"    {name}: {kind} | None = None"
        for name, kind in kinds.items()
        if name not in in_every or name == "truth"
    ]
    return "\n".join([*required, *optional]) or "    pass"


def alive_of_group(group: int) -> list[int]:
    """Return the running processes of a process group, without zombies."""
    alive = []
    for process in map(int, filter(str.isdigit, os.listdir("/proc"))):
        try:
            state, _, its_group = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[:3]
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(its_group) == group and state not in "ZX":
            alive.append(process)
    return alive


def wait_for_group(group: int) -> None:
    """Wait until a killed process group has ended: Make may end before its children."""
    while alive_of_group(group):
        time.sleep(0.01)
