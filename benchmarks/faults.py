"""Inject random faults into a small real build and count wrong results: `python -m benchmarks.faults --kills 200`.

Two agents are built on a dedicated file system (tmpfs, which needs root): recordings up to flow and features,
and the training of a behavior model. Faults: SIGKILL of the process group, also during training; a disk that
fills up at a random byte; SIGSTOP, a concurrent second `make`, then SIGCONT; clock steps backward or forward (all
times in `build/` are shifted) with a changed recipe. After each fault every complete artifact is compared bit by
bit with that of a reference build without faults; at the end the build is finished and compared as a whole.
"""

import contextlib
import os
import random
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks import command_lines
from benchmarks.workflow_scale import ROOT
from pipeline.workflow import artifact

LINKED = ("pipeline", "stages", "envs", ".venv")
DISK_MB = 6000
"""More than both builds and the free space that a stage requires."""
MAX_SPARE_BYTES = 1 << 20
"""Space that a full disk leaves at most."""
MAX_CLOCK_STEP_S = 400 * 24 * 3600
MAX_DELAY = 0.1
"""Maximal delay before a fault, as a fraction of the duration of the reference build."""
RECIPES = {
    "filmed": """[synthesize_capture]
session_count = 2
session_s = 2.0
test_session_s = 2.0
walkthrough_s = 3.0
turnaround_s = 2.0
heldout_of = 0
dim_session = 0
sideways_session = 0
""",
    "lives": """[flow]
begins_at = "trajectories"

[train_behavior]
export = false
ensemble_size = 1
seed = {seed}

[train_behavior.training.optimization]
steps = 40
goal_steps = 16
batch = 8
goal_batch = 8
""",
}
GOALS = ("filmed.features", "filmed.flow", "lives.behavior")
TRAINING = ("lives.behavior",)
WALK_S = 30
TIMEOUT_S = 1800
"""A build that takes longer counts as hanging, a manual repair."""


def walk(number: int) -> str:
    """Return a CSV table of an animal that walks in circles for `WALK_S` seconds."""
    rows = ["id,time,x,y,z,heading"]
    for frame in range(10 * WALK_S):
        angle = 0.05 * frame + number
        rows.append(f"a,{frame / 10},{np.sin(angle):.4f},0.2,{np.cos(angle):.4f},{angle + np.pi / 2:.4f}")
    return "\n".join(rows) + "\n"


@dataclass
class FaultResults:
    """Injected faults and their consequences."""

    faults: dict[str, int] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)
    """complete artifacts that differ from the reference"""
    manual_repairs: list[str] = field(default_factory=list)
    """builds that did not recover by themselves, or ended without an error code"""


@dataclass(frozen=True)
class Checkout:
    """A working copy with linked code."""

    folder: Path

    def create(self) -> "Checkout":
        """Link the code; write recipes and captures."""
        (self.folder / "agents").mkdir(parents=True)
        for name in LINKED:
            (self.folder / name).symlink_to(ROOT / name)
        shutil.copy(ROOT / "Makefile", self.folder)
        captures = self.folder / "captures" / "lives"
        captures.mkdir(parents=True)
        for number in range(2):
            (captures / f"walk-{number}.csv").write_text(walk(number))
        self.write_recipes(0)
        return self

    def write_recipes(self, seed: int) -> None:
        """Write the recipes with this seed of the training."""
        for agent, text in RECIPES.items():
            (self.folder / "agents" / f"{agent}.toml").write_text(text.replace("{seed}", str(seed)))

    def make(self, *goals: str) -> subprocess.Popen[bytes]:
        """Start a build in its own process group; its output is appended to `build.log`."""
        with (self.folder / "build.log").open("ab") as log:
            return subprocess.Popen(
                ["make", "-j2", *goals], cwd=self.folder, start_new_session=True, stdout=log, stderr=log
            )

    def log(self) -> str:
        """Return and clear the output of builds."""
        path = self.folder / "build.log"
        text = path.read_text(errors="replace")
        path.write_text("")
        return text

    def artifacts(self) -> dict[str, tuple[bytes, dict[str, str]]]:
        """Return manifest and digests of every complete artifact."""
        found = {}
        for path in sorted((self.folder / "build").rglob(artifact.MANIFEST)):
            inside = path.parent.relative_to(self.folder / "build")
            if not any(part.startswith(".") for part in inside.parts):
                found[inside.as_posix()] = (path.read_bytes(), artifact.digests(path.parent))
        return found

    def temporary_folders(self) -> list[Path]:
        """Return temporary folders of killed writers."""
        return [path for kind in (".*.tmp*", ".*.old*") for path in (self.folder / "build").rglob(kind)]


class FaultInjection:
    """A checkout into which faults are injected, and reference builds for both training seeds."""

    def __init__(self, disk: Path, random_seed: int):
        self.disk, self.rng, self.results, self.seed = disk, random.Random(random_seed), FaultResults(), 0
        self.references, self.build_s = [], 0.0
        reference = Checkout(disk / "reference").create()
        for seed in range(2):
            reference.write_recipes(seed)
            start = time.monotonic()
            assert reference.make(*(TRAINING if seed else GOALS)).wait() == 0, reference.log()[-3000:]
            self.build_s = self.build_s or time.monotonic() - start
            self.references.append(reference.artifacts())
        self.checkout = Checkout(disk / "faulty").create()

    def inject(self, name: str, fault: Callable[[], None]) -> None:
        """Inject one fault and check the complete artifacts afterwards."""
        fault()
        self.results.faults[name] = self.results.faults.get(name, 0) + 1
        log = self.checkout.log()
        if "Traceback" in log:
            self.results.manual_repairs.append(f"{name}: {log[log.index('Traceback') :][:2000]}")
        done = self._compare(name)
        print(
            f"{sum(self.results.faults.values()):4} {name:8} {len(done):3} complete,"
            f" wrong {len(self.results.wrong)}, manual repairs {len(self.results.manual_repairs)}",
            flush=True,
        )
        if len(done) == len(self.references[0]):  # leave something to build
            cheap = [each for each in sorted(done) if "synthetic" not in each]
            for each in self.rng.sample(cheap, len(cheap) // 2):
                shutil.rmtree(self.checkout.folder / "build" / each)

    def finish(self) -> None:
        """Finish the build without faults and compare all of it."""
        self._expect_success("at the end", self.checkout.make(*GOALS))
        done = self._compare("at the end")
        missing = sorted(self.references[0].keys() - done.keys())
        self.results.wrong += [f"at the end: {name} is missing" for name in missing]
        self.results.manual_repairs += [
            f"at the end: {path} is left over" for path in self.checkout.temporary_folders()
        ]

    def kill(self) -> None:
        """SIGKILL the build at a random time."""
        self._kill(GOALS)

    def kill_training(self) -> None:
        """SIGKILL during the training, or just before or after it."""
        shutil.rmtree(self.checkout.folder / "build/lives/behavior", ignore_errors=True)
        self._kill(TRAINING)

    def full_disk(self) -> None:
        """Leave a random number of bytes free at a random time, until the build ends."""
        build = self.checkout.make(*GOALS)
        self._sleep()
        spare = int(MAX_SPARE_BYTES * self.rng.random() ** 3)
        while build.poll() is None:
            try:
                _mount(self.disk, shutil.disk_usage(self.disk).used + spare, "remount")
                break
            except subprocess.CalledProcessError:
                pass  # the build has written more meanwhile, and a file system cannot be smaller than its content
        code = build.wait(TIMEOUT_S)
        _mount(self.disk, DISK_MB << 20, "remount")
        if code and "SYS-001" not in (self.checkout.folder / "build.log").read_text(errors="replace"):
            self.results.manual_repairs.append(f"full disk: exit code {code} without SYS-001")

    def stop_and_continue(self) -> None:
        """SIGSTOP a build, start a second one, continue the first."""
        first = self.checkout.make(*GOALS)
        self._sleep()
        os.killpg(first.pid, signal.SIGSTOP)
        second = self.checkout.make(*GOALS)
        self._sleep()
        os.killpg(first.pid, signal.SIGCONT)
        for build in (first, second):
            self._expect_success("stop", build)

    def step_clock(self) -> None:
        """Step the clock and change a recipe: artifacts of the other recipe must not be reused."""
        self.seed = 1 - self.seed
        offset_ns = round(self.rng.uniform(-MAX_CLOCK_STEP_S, MAX_CLOCK_STEP_S) * 1e9)
        for path in (self.checkout.folder / "build").rglob("*"):
            time_ns = path.stat().st_mtime_ns + offset_ns
            os.utime(path, ns=(time_ns, time_ns))
        self.checkout.write_recipes(self.seed)
        self._expect_success("clock", self.checkout.make(*TRAINING))

    def _kill(self, goals: tuple[str, ...]) -> None:
        build = self.checkout.make(*goals)
        self._sleep()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(build.pid, signal.SIGKILL)
        build.wait()
        while _alive(build.pid):
            time.sleep(0.01)

    def _sleep(self) -> None:
        time.sleep(self.rng.uniform(0, MAX_DELAY * self.build_s))

    def _expect_success(self, name: str, build: subprocess.Popen[bytes]) -> None:
        """Wait for a build that must succeed."""
        try:
            code = build.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            os.killpg(build.pid, signal.SIGKILL)
            code = -signal.SIGKILL
        if code:
            self.results.manual_repairs.append(f"{name}: exit code {code}: {self.checkout.log()[-2000:]}")

    def _compare(self, name: str) -> dict[str, tuple[bytes, dict[str, str]]]:
        """Return the complete artifacts; record those that differ from the reference.

        Until the next build a training may be that of the other seed: the stamp records the seed, the artifact
        does not.
        """
        done = self.checkout.artifacts()
        for inside, found in done.items():
            if found not in [known[inside] for known in self.references if inside in known]:
                self.results.wrong.append(f"{name}: {inside}")
        if (
            name in ("clock", "at the end")
            and done.get("lives/behavior") != (self.references[self.seed]["lives/behavior"])
        ):
            self.results.wrong.append(f"{name}: lives/behavior is that of another recipe, or missing")
        return done


def _alive(group: int) -> bool:
    """Return whether a process of the group still runs."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            state, _, of_group = stat.read_text().rpartition(")")[2].split()[:3]
            if int(of_group) == group and state not in "ZX":
                return True
    return False


def _mount(folder: Path, size: int, *options: str) -> None:
    """Mount a file system in memory of ``size`` bytes at ``folder``, or change its size."""
    options = (*options, f"size={size}")
    subprocess.run(["mount", "-t", "tmpfs", "-o", ",".join(options), "faults", folder], check=True)


@contextlib.contextmanager
def temporary_file_system() -> Iterator[Path]:
    """Yield a folder on a temporary file system."""
    with tempfile.TemporaryDirectory() as name:
        _mount(Path(name), DISK_MB << 20)
        try:
            yield Path(name)
        finally:
            subprocess.run(["umount", "-l", name], check=True)


def main() -> None:
    """Inject faults and print the results."""
    parser = command_lines.described(__doc__)
    counts = {"kills": 200, "training_kills": 50, "full_disks": 50, "stops": 20, "clock_steps": 20}
    for name, default in counts.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=default)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="inject no fault after this")
    arguments = parser.parse_args()
    with temporary_file_system() as disk:
        injection = FaultInjection(disk, arguments.seed)
        print(f"reference build: {injection.build_s:.0f} s", flush=True)
        kinds = {
            "kills": injection.kill,
            "training_kills": injection.kill_training,
            "full_disks": injection.full_disk,
            "stops": injection.stop_and_continue,
            "clock_steps": injection.step_clock,
        }
        order = [name for name in counts for _ in range(getattr(arguments, name))]
        injection.rng.shuffle(order)
        end = time.monotonic() + 60 * arguments.minutes
        for name in order:
            if time.monotonic() < end:
                injection.inject(name, kinds[name])
        injection.finish()
        for problem in (*injection.results.wrong, *injection.results.manual_repairs):
            print(problem)
        print(injection.results.faults)
        print(
            f"wrong results {len(injection.results.wrong)}, manual repairs {len(injection.results.manual_repairs)}"
        )


if __name__ == "__main__":
    main()
