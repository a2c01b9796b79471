"""A small house of its own for tests of the orchestration: the real ground floor, tiny stages, real recipes."""

import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from pipeline import dag

ROOT = Path(__file__).parents[2]
SETTINGS = {
    "synthesize_capture": "    session_count: int = 2\n    heldout_of: int = 1\n    foreign_sessions: int = 0\n",
    "train_localizer": "    target: str = ''\n",
    "train_longterm": '    ablations: str = "none"\n',
}
STAGE = '''"""Hash the inputs."""

import hashlib
import time
from dataclasses import dataclass

from pipeline import cli, dag


@dataclass(frozen=True)
class Config:
    seed: int = 0
    pause_s: float = 0.0
    fail: bool = False
{settings}

def run(task):
    digest = hashlib.sha256(repr(task.config).encode())
    needs = {{need.option or need.artifact: need for node in dag.FLOW if node.stage == {stage!r} for need in dag.needs_of(node, "recordings")}}
    for name in sorted(task.paths):
        need = needs[name]
        if name in dag.NODES and dag.NODES[name].roles and task.video is None:
            found = task.per_video(name, roles=need.roles, splits=need.splits).values()
        else:
            found = [task.input(name)]
        for path in found:
            files = [path] if path.is_file() else sorted(p for p in path.rglob("*.bin"))
            for file in files:
                digest.update(file.read_bytes())
    if task.config.fail:
        raise cli.InputError("TST-001", "told to fail", {stage!r}, "do not")
    with task.create() as folder:
        for i in range(3):
            (folder / f"{{i}}.bin").write_bytes(digest.digest() * 64 * (i + 1))
            time.sleep(task.config.pause_s)
        if {stage!r} == "synthesize_capture":
            for kind in ("recordings", "truth"):
                (folder / kind).mkdir()
                sessions = [f"session-{{i + 1}}" for i in range(task.config.session_count)]
                for name in ["walkthrough", "turnaround", *sessions, "heldout"]:
                    (folder / kind / f"{{name}}.r3d").write_bytes(f"{{kind}} {{name}} {{task.config.seed}}".encode())


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads={reads!r}, optional={optional!r})
'''


@dataclass(frozen=True)
class Checkout:
    """A working copy with tiny stages."""

    folder: Path

    def python(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a module of the house as Make does."""
        return subprocess.run([sys.executable, "-SE", "-m", *arguments], cwd=self.folder, capture_output=True, text=True)

    def make(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run make."""
        command = ["make", "--no-print-directory", f"PYTHON={sys.executable}", *arguments]
        return subprocess.run(command, cwd=self.folder, capture_output=True, text=True)

    def write(self, name: str, text: str) -> None:
        """Write a file of the working copy."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def tree(self) -> dict[str, bytes]:
        """Return every file and its bytes, apart from Python's own caches."""
        files = (path for path in self.folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
        return {path.relative_to(self.folder).as_posix(): path.read_bytes() for path in files}


def create(folder: Path) -> Checkout:
    """Make a working copy in `folder` with the agent `toy`."""
    shutil.copytree(ROOT / "pipeline", folder / "pipeline", ignore=shutil.ignore_patterns("__pycache__", "models", "space"))
    shutil.copy(ROOT / "Makefile", folder)
    shutil.copy(ROOT / "Snakefile", folder)
    made = Checkout(folder)
    for name in ("envs/cpu.txt", "envs/cuda.txt", "envs/setup", ".venv/.ok", "stages/__init__.py", "agents/toy.toml"):
        made.write(name, "")
    made.write("agents/variants/other.toml", "[train_behavior]\nseed = 7\n")
    for stage in {node.stage for node in dag.nodes_of("recordings")}:
        of_nodes = [dag.needs_of(node, "recordings") for node in dag.FLOW if node.stage == stage]
        options = [[need.option or need.artifact for need in needs] for needs in of_nodes]
        names = tuple(dict.fromkeys(name for each in options for name in each))
        reads = tuple(name for name in names if name != "truth" and all(name in each for each in options))
        optional = tuple(name for name in names if name not in reads)
        settings = SETTINGS.get(stage, "")
        made.write(f"stages/{stage}/__init__.py", "")
        made.write(f"stages/{stage}/__main__.py", STAGE.format(stage=stage, settings=settings, reads=reads, optional=optional))
    return made


def alive_of_group(group: int) -> list[int]:
    """Return the processes of a process group that have not ended yet; those that nobody has waited for have."""
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
    """Wait until a killed process group has ended: Make may be gone before what it started."""
    while alive_of_group(group):
        time.sleep(0.01)
