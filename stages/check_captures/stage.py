"""The stage: recordings with their roles -> a verdict each; the walk-through first, the others against it."""

import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core.errors import InputError
from pipeline.core.videos import Role
from pipeline.recordings.formats import open_recording
from stages.check_captures import moving_objects, overlap, parallax, pose_drift, sampling, text
from stages.check_captures.config import Config
from stages.check_captures.overlap import DescribedFrame
from stages.check_captures.problems import CaptureMeasurements, CaptureProblem, problems

MAX_DEPTH_M = 6.0


@dataclass(frozen=True)
class CaptureVerdict:
    """Verdict on one recording."""

    name: str
    role: Role
    seen: CaptureMeasurements | None
    """None if it is unusable"""
    problems: tuple[CaptureProblem, ...]
    text: str

    @property
    def usable(self) -> bool:
        """Return whether a build goes on with it: the held-out phone must have depth."""
        return self.seen is not None and (self.seen.sample.plan is not None or self.role != "heldout")


def run(files: Sequence[tuple[Path, Role]], config: Config) -> Iterator[CaptureVerdict]:
    """Yield a verdict per recording as soon as it is known; walk-throughs come first."""
    room: list[DescribedFrame] = []
    rng = np.random.default_rng(config.seed)
    for path, role in sorted(files, key=lambda file: (file[1] != "walkthrough", file[0].name)):
        try:
            sample = sampling.sample(open_recording(path), config.samples, max_depth_m=MAX_DEPTH_M)
            seen = _seen(sample, role, room, rng)
        except InputError as error:
            yield refused(path, role, error)
        except Exception as error:  # one broken file must not prevent the other verdicts
            traceback.print_exception(error)
            what = f"reading it fails in a way that is not foreseen: {error!r}"
            remedy = "export it again; if that does not help, report the traceback above"
            yield refused(path, role, InputError("CAP-012", what, str(path), remedy))
        else:
            found = tuple(problems(seen, role))
            described = text.describe_capture(path.name, role, seen, found)
            yield CaptureVerdict(path.name, role, seen, found, described)


def refused(path: Path, role: Role, error: InputError) -> CaptureVerdict:
    """Return the verdict on a recording that cannot be used."""
    found = (CaptureProblem(error.code, error.what, error.remedy),)
    return CaptureVerdict(path.name, role, None, found, text.refused(path, role, error))


def _seen(
    sample: sampling.RecordingSample, role: Role, room: list[DescribedFrame], rng: np.random.Generator
) -> CaptureMeasurements:
    """Measure what a role asks for; a walk-through's described frames are added to ``room``."""
    if sample.plan is None:
        shifted = parallax.parallax(sample.shots) if role == "walkthrough" else None
        return CaptureMeasurements(sample, parallax=shifted)
    drift_m = pose_drift.drift_m(sample.shots)
    moving = moving_objects.find_motion(sample.shots) if role in ("walkthrough", "session") else None
    if role == "walkthrough":
        room += overlap.describe(sample.shots)
        return CaptureMeasurements(sample, drift_m, moving)
    placed = None
    if room and role != "turnaround":  # may be filmed anywhere: only the animal's template is made from it
        placed = overlap.placed_share(room, overlap.describe(sample.shots), rng)
    return CaptureMeasurements(sample, drift_m, moving, placed)
