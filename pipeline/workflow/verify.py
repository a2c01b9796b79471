"""Verify the checksums of everything that was built, and of the recordings that it was built from.

    python -SE -m pipeline.workflow.verify HOME

A build compares the keys of artifacts, not their bytes: this finds what a failing disk or another program
has changed. The planner compares size and times of recordings; its cache is dropped if a hash differs all
the same, so that the next build uses the new content. Exit code 2 if anything differs. Standard library only.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

from pipeline.core import videos
from pipeline.core.errors import InputError, exit_code
from pipeline.workflow import artifact
from pipeline.workflow.jobs import Home, read_jobs
from pipeline.workflow.sources import recording_digest


def differences(home: Home) -> Iterator[InputError]:
    """Yield an error per damaged artifact and changed recording of `home`. Raises RUN-001 without a plan."""
    for folder in dict.fromkeys(Path(job["out"]) for job in read_jobs(home)):
        if changed := artifact.damaged(folder):
            more = f" (and {len(changed) - 1} more files)" if changed[1:] else ""
            what = f"has been damaged, changed or deleted since it was made{more}"
            remedy = f"rm -r {folder}, and build again"
            yield InputError("ART-005", what, str(folder / changed[0]), remedy)
    for video in videos.read(home.base.plan / "videos.json"):
        recording = Path("captures", home.agent, video.file)
        if video.sha256 is None or not recording.exists():
            continue
        if recording_digest(recording) != video.sha256:
            for cached in ("cache.json", "state.json"):
                (home.base.plan / cached).unlink(missing_ok=True)
            what = "has changed since it was planned"
            yield InputError("ART-005", what, str(recording), "build again, or put back what was there")


def main(arguments: list[str]) -> int:
    """Run the command line; returns its exit code."""
    if len(arguments) != 1:
        print(__doc__, file=sys.stderr)
        return 2
    found = list(differences(Home.parse(arguments[0])))
    for error in found:
        print(f"error: {error}", file=sys.stderr)
    if not found:
        print(f"[{arguments[0]}] every artifact and recording is what it was")
    return 2 if found else 0


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
