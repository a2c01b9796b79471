"""Disturb a small real build at random and count wrong results: `python -m benchmarks.faults --kills 200`.

Two agents are built on a file system of their own (tmpfs, which needs root): recordings up to flow and
features, and the training of a behavior model. Faults: SIGKILL of the process group, also while training; the
disk full at a random byte; SIGSTOP with a second `make` meanwhile, then SIGCONT; the clock put back or
forward (all times in `build/` are moved) with a recipe that changed. After each fault every artifact that
counts as complete is compared with that of an undisturbed build, bit by bit; at the end the build is finished
and compared as a whole.
"""

import argparse
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

from benchmarks.workflow_scale import ROOT
from pipeline.workflow import artifact

LINKED = ("pipeline", "stages", "envs", ".venv")
DISK_MB = 6000
"""More than both builds and what a stage wants free before it begins."""
FULL_BYTES = 1 << 20
"""A full disk leaves at most this much."""
FARTHEST_S = 400 * 24 * 3600
"""The clock is moved by up to this."""
SHARE = 0.1
"""Of an undisturbed build's time within which a fault comes."""
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
WAIT_S = 1800
"""A build that takes longer hangs, which counts as one that needs a hand."""


def walk(number: int) -> str:
    """Return a table of an animal that walks in circles for `WALK_S` seconds."""
    rows = ["id,time,x,y,z,heading"]
    for frame in range(10 * WALK_S):
        angle = 0.05 * frame + number
        rows.append(f"a,{frame / 10},{np.sin(angle):.4f},0.2,{np.cos(angle):.4f},{angle + np.pi / 2:.4f}")
    return "\n".join(rows) + "\n"


@dataclass
class Count:
    """What came of the faults."""

    faults: dict[str, int] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)
    """complete artifacts that differ from the undisturbed ones"""
    by_hand: list[str] = field(default_factory=list)
    """builds that did not go on by themselves, or ended without a code"""


@dataclass(frozen=True)
class Checkout:
    """A working copy and the seed of its training."""

    folder: Path

    def create(self) -> "Checkout":
        """Link the code and write the recipes."""
        (self.folder / "agents").mkdir(parents=True)
        for name in LINKED:
            (self.folder / name).symlink_to(ROOT / name)
        shutil.copy(ROOT / "Makefile", self.folder)
        captures = self.folder / "captures" / "lives"
        captures.mkdir(parents=True)
        for number in range(2):
            (captures / f"walk-{number}.csv").write_text(walk(number))
        self.choose(0)
        return self

    def choose(self, seed: int) -> None:
        """Write the recipes with a seed of the training."""
        for agent, text in RECIPES.items():
            (self.folder / "agents" / f"{agent}.toml").write_text(text.replace("{seed}", str(seed)))

    def make(self, *goals: str) -> subprocess.Popen[bytes]:
        """Begin a build in a process group of its own; what it prints is added to `build.log`."""
        with (self.folder / "build.log").open("ab") as log:
            return subprocess.Popen(
                ["make", "-j2", *goals], cwd=self.folder, start_new_session=True, stdout=log, stderr=log
            )

    def log(self) -> str:
        """Return what builds have printed since this was called last."""
        path = self.folder / "build.log"
        text = path.read_text(errors="replace")
        path.write_text("")
        return text

    def artifacts(self) -> dict[str, tuple[bytes, dict[str, str]]]:
        """Return manifest and digests of every artifact that counts as complete."""
        found = {}
        for path in sorted((self.folder / "build").rglob(artifact.MANIFEST)):
            inside = path.parent.relative_to(self.folder / "build")
            if not any(part.startswith(".") for part in inside.parts):
                found[inside.as_posix()] = (path.read_bytes(), artifact.digests(path.parent))
        return found

    def left_over(self) -> list[Path]:
        """Return what dead writers left."""
        return [path for kind in (".*.tmp*", ".*.old*") for path in (self.folder / "build").rglob(kind)]


class Disturbance:
    """The disturbed checkout, beside undisturbed builds for both seeds."""

    def __init__(self, disk: Path, random_seed: int):
        self.disk, self.choice, self.count, self.seed = disk, random.Random(random_seed), Count(), 0
        self.undisturbed, self.build_s = [], 0.0
        made = Checkout(disk / "undisturbed").create()
        for seed in range(2):
            made.choose(seed)
            begin = time.monotonic()
            assert made.make(*(TRAINING if seed else GOALS)).wait() == 0, made.log()[-3000:]
            self.build_s = self.build_s or time.monotonic() - begin
            self.undisturbed.append(made.artifacts())
        self.here = Checkout(disk / "disturbed").create()

    def apply(self, name: str, fault: Callable[[], None]) -> None:
        """Let one fault happen and look at what counts as complete afterwards."""
        fault()
        self.count.faults[name] = self.count.faults.get(name, 0) + 1
        log = self.here.log()
        if "Traceback" in log:
            self.count.by_hand.append(f"{name}: {log[log.index('Traceback') :][:2000]}")
        done = self._compare(name)
        print(
            f"{sum(self.count.faults.values()):4} {name:8} {len(done):3} complete,"
            f" wrong {len(self.count.wrong)}, by hand {len(self.count.by_hand)}",
            flush=True,
        )
        if len(done) == len(self.undisturbed[0]):  # there must be something left to do
            cheap = [each for each in sorted(done) if "synthetic" not in each]
            for each in self.choice.sample(cheap, len(cheap) // 2):
                shutil.rmtree(self.here.folder / "build" / each)

    def finish(self) -> None:
        """Finish the build undisturbed and compare all of it."""
        self._ended("at the end", self.here.make(*GOALS))
        done = self._compare("at the end")
        missing = sorted(self.undisturbed[0].keys() - done.keys())
        self.count.wrong += [f"at the end: {name} is missing" for name in missing]
        self.count.by_hand += [f"at the end: {path} is left over" for path in self.here.left_over()]

    def kill(self) -> None:
        """SIGKILL everything at a random time."""
        self._kill(GOALS)

    def kill_training(self) -> None:
        """SIGKILL while the training runs, or just before or after."""
        shutil.rmtree(self.here.folder / "build/lives/behavior", ignore_errors=True)
        self._kill(TRAINING)

    def full_disk(self) -> None:
        """Leave a random number of bytes free at a random time; go on when there is room again."""
        build = self.here.make(*GOALS)
        self._sleep()
        spare = int(FULL_BYTES * self.choice.random() ** 3)
        while build.poll() is None:
            try:
                _mount(self.disk, shutil.disk_usage(self.disk).used + spare, "remount")
                break
            except subprocess.CalledProcessError:
                pass  # the build has written more meanwhile, and what is used cannot be taken away
        code = build.wait(WAIT_S)
        _mount(self.disk, DISK_MB << 20, "remount")
        if code and "SYS-001" not in (self.here.folder / "build.log").read_text(errors="replace"):
            self.count.by_hand.append(f"full disk: exit code {code} without SYS-001")

    def stop_and_continue(self) -> None:
        """Stop a build, begin another one beside it, continue the first."""
        first = self.here.make(*GOALS)
        self._sleep()
        os.killpg(first.pid, signal.SIGSTOP)
        second = self.here.make(*GOALS)
        self._sleep()
        os.killpg(first.pid, signal.SIGCONT)
        for build in (first, second):
            self._ended("stop", build)

    def step_clock(self) -> None:
        """Put the clock back or forward, and change a recipe: what was built for the other is not taken."""
        self.seed = 1 - self.seed
        offset_ns = round(self.choice.uniform(-FARTHEST_S, FARTHEST_S) * 1e9)
        for path in (self.here.folder / "build").rglob("*"):
            time_ns = path.stat().st_mtime_ns + offset_ns
            os.utime(path, ns=(time_ns, time_ns))
        self.here.choose(self.seed)
        self._ended("clock", self.here.make(*TRAINING))

    def _kill(self, goals: tuple[str, ...]) -> None:
        build = self.here.make(*goals)
        self._sleep()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(build.pid, signal.SIGKILL)
        build.wait()
        while _alive(build.pid):
            time.sleep(0.01)

    def _sleep(self) -> None:
        time.sleep(self.choice.uniform(0, SHARE * self.build_s))

    def _ended(self, name: str, build: subprocess.Popen[bytes]) -> None:
        """Wait for a build that nothing hinders from ending well."""
        try:
            code = build.wait(WAIT_S)
        except subprocess.TimeoutExpired:
            os.killpg(build.pid, signal.SIGKILL)
            code = -signal.SIGKILL
        if code:
            self.count.by_hand.append(f"{name}: exit code {code}: {self.here.log()[-2000:]}")

    def _compare(self, name: str) -> dict[str, tuple[bytes, dict[str, str]]]:
        """Return what counts as complete; note what is not that of an undisturbed build.

        Before the next build a training may be that of the other seed: its stamp says so, not the artifact.
        """
        done = self.here.artifacts()
        for inside, made in done.items():
            if made not in [known[inside] for known in self.undisturbed if inside in known]:
                self.count.wrong.append(f"{name}: {inside}")
        if (
            name in ("clock", "at the end")
            and done.get("lives/behavior") != (self.undisturbed[self.seed]["lives/behavior"])
        ):
            self.count.wrong.append(f"{name}: lives/behavior is that of another recipe, or missing")
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
def mounted() -> Iterator[Path]:
    """Yield a folder on a file system of its own."""
    with tempfile.TemporaryDirectory() as name:
        _mount(Path(name), DISK_MB << 20)
        try:
            yield Path(name)
        finally:
            subprocess.run(["umount", "-l", name], check=True)


def main() -> None:
    """Disturb and print what came of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    counts = {"kills": 200, "training_kills": 50, "full_disks": 50, "stops": 20, "clock_steps": 20}
    for name, default in counts.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=default)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no fault after this")
    given = parser.parse_args()
    with mounted() as disk:
        disturbance = Disturbance(disk, given.seed)
        print(f"undisturbed: {disturbance.build_s:.0f} s", flush=True)
        kinds = {
            "kills": disturbance.kill,
            "training_kills": disturbance.kill_training,
            "full_disks": disturbance.full_disk,
            "stops": disturbance.stop_and_continue,
            "clock_steps": disturbance.step_clock,
        }
        order = [name for name in counts for _ in range(getattr(given, name))]
        disturbance.choice.shuffle(order)
        end = time.monotonic() + 60 * given.minutes
        for name in order:
            if time.monotonic() < end:
                disturbance.apply(name, kinds[name])
        disturbance.finish()
        for what in (*disturbance.count.wrong, *disturbance.count.by_hand):
            print(what)
        print(disturbance.count.faults)
        print(f"wrong results {len(disturbance.count.wrong)}, by hand {len(disturbance.count.by_hand)}")


if __name__ == "__main__":
    main()
