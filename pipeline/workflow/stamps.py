"""Stamp files mark artifacts as up to date by content hash, independent of the machine's clock.

A stamp holds a hash of its job's key files: if that differs, the planner removes it, and Make or Snakemake
run the job. Both compare modification times of stamps, so these come from a monotonic clock per agent:
every stamp gets a later time than all before. Standard library only.
"""

import contextlib
import functools
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from pipeline.workflow import artifact, dag
from pipeline.workflow.jobs import Home, Job

TICK_NS = 1_000_000
"""Minimum time between two stamps; file systems resolve milliseconds."""


def put(stamp: Path, keys: Sequence[str]) -> None:
    """Write the stamp of an up-to-date artifact; `keys` are its job's key files."""
    stamp.write_text(text(artifact.digest_of_file(Path(key)) for key in keys))
    clock = _clock(Home(stamp.parts[1]))
    with artifact.locked(clock):
        later_ns = max(time.time_ns(), clock.stat().st_mtime_ns + TICK_NS)
        os.utime(clock, ns=(later_ns, later_ns))
    os.utime(stamp, ns=(later_ns, later_ns))


def text(digests: Iterable[str]) -> str:
    """Return the content of the stamp of a job whose key files have these digests."""
    return artifact.digest_of(list(digests)) + "\n"


def remove_outdated(jobs: Sequence[Job]) -> None:
    """Remove the stamps of jobs whose key files have changed."""
    digest_of = functools.cache(lambda key: artifact.digest_of_file(Path(key)))
    for job in jobs:
        with contextlib.suppress(FileNotFoundError):
            if Path(job.stamp).read_text(errors="replace") != text(map(digest_of, job.keys)):
                Path(job.stamp).unlink()


def remove_impossible(home: Home) -> None:
    """Remove stamps with a time in the future, not written by `put`: they would hide every change."""
    now_ns = time.time_ns()
    with contextlib.suppress(FileNotFoundError):
        now_ns = max(now_ns, _clock(home).stat().st_mtime_ns)
    for stamp in _all_stamps(home):
        with contextlib.suppress(FileNotFoundError):
            if os.stat(stamp).st_mtime_ns > now_ns:
                os.unlink(stamp)


def _all_stamps(home: Home) -> Iterator[str]:
    for node in dag.FLOW:
        folder = f"{home.folder}/{node.artifact}"
        if not node.several:
            yield f"{folder}/{artifact.STAMP}"
        elif os.path.isdir(folder):
            yield from (f"{each.path}/{artifact.STAMP}" for each in os.scandir(folder))


def _clock(home: Home) -> Path:
    """Return the file whose modification time is the last stamp's; an agent's variants share it."""
    return home.base.folder / "clock"
