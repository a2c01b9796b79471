"""The stage: recordings with their roles -> a verdict each; the walk-through first, the others against it."""

import math
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.calibration import given
from pipeline.calibration.recordings import describe
from pipeline.core.errors import InputError
from pipeline.core.videos import Role
from pipeline.recordings import errors
from pipeline.recordings.formats import open_recording
from stages.check_captures import moving_objects, overlap, parallax, sampling
from stages.check_captures.overlap import DescribedFrame
from stages.check_captures.problems import CaptureMeasurements, problems

MAX_DEPTH_M = 6.0
SAMPLES, SEED = 40, 0
"""frames sampled per recording; seed of the robust fits"""


@dataclass(frozen=True)
class CaptureVerdict:
    """Verdict on one recording."""

    usable: bool
    """whether a build goes on with it: the held-out phone must have depth"""
    text: str
    """format, measurements, and problems with remedies"""


def run(files: Sequence[tuple[Path, Role]]) -> Iterator[CaptureVerdict]:
    """Yield a verdict per recording as soon as it is known; walk-throughs come first."""
    room: list[DescribedFrame] = []
    rng = np.random.default_rng(SEED)
    for path, role in sorted(files, key=lambda file: (file[1] != "walkthrough", file[0].name)):
        try:
            stated = given.sidecar_of(path)
            sample = sampling.sample(open_recording(path), SAMPLES, max_depth_m=MAX_DEPTH_M, given=stated)
            seen = _seen(sample, role, room, rng)
        except InputError as error:
            yield refused(path, role, error)
        except Exception as error:  # one broken file must not prevent the other verdicts
            traceback.print_exception(error)
            what = f"reading it fails in a way that is not foreseen: {error!r}"
            remedy = "export it again; if that does not help, report the traceback above"
            yield refused(path, role, InputError("CAP-012", what, str(path), remedy))
        else:
            yield CaptureVerdict(True, _described(path.name, role, seen))


def refused(path: Path, role: Role, error: InputError) -> CaptureVerdict:
    """Return the verdict on a recording that cannot be used, and because of which file."""
    file = error.where.removeprefix(f"{path.parent}/")
    what = error.what if file in (path.name, str(path.parent)) else f"{file}: {error.what}"
    return CaptureVerdict(False, f"{path.name}  {role}\n  {error.code} {what}\n    -> {error.remedy}")


def _seen(
    sample: sampling.RecordingSample, role: Role, room: list[DescribedFrame], rng: np.random.Generator
) -> CaptureMeasurements:
    """Measure what a role asks for; a walk-through's described frames are added to ``room``."""
    if sample.plan is None:
        if role == "heldout":
            raise errors.no_depth(sample.recording.where, "the held-out phone measures it")
        shifted = parallax.parallax(sample.shots) if role == "walkthrough" else None
        return CaptureMeasurements(sample, parallax=shifted)
    drift_m = overlap.drift_m(sample.shots)
    moving = moving_objects.find_motion(sample.shots) if role in ("walkthrough", "session") else None
    if role == "walkthrough":
        room += overlap.describe(sample.shots)
        return CaptureMeasurements(sample, drift_m, moving)
    placed = None
    if room and role != "turnaround":  # may be filmed anywhere: only the animal's template is made from it
        described = overlap.describe(sample.shots)
        placed = overlap.placed_share(room, described, rng)
        check, factor = sample.plan.pose_check, 1.0
        if sample.plan.odometry_from_camera is None and check.depth_factor == 1:
            factor = overlap.depth_factor(room, described, rng)
        if factor != 1:
            reason = f"{check.reason}; depth times {factor:g} would fit the walk-through: check its unit"
            check = replace(check, reason=reason, depth_factor=factor)
            sample = replace(sample, plan=replace(sample.plan, pose_check=check))
    return CaptureMeasurements(sample, drift_m, moving, placed)


def _described(name: str, role: Role, seen: CaptureMeasurements) -> str:
    """Return a recording's format, measurements, and problems with remedies."""
    sample, recording, found = seen.sample, seen.sample.recording, problems(seen, role)
    height, width = recording.color_size
    turns = sample.plan.quarter_turns if sample.plan else recording.quarter_turns
    turned = f"turned {90 * turns} deg clockwise to be upright" if turns else "upright as stored"
    lines = [
        f"{name}  {role}, {recording.kind}",
        f"  {sample.duration_s:.1f} s, {sample.rate_hz:.1f} fps, {width} x {height}, {turned}",
        f"  pictures: dark {sample.dark:.0%}, blurred {sample.blurred:.0%}",
    ]
    if sample.plan is not None:
        lines[-1] += f"; depth: typically {sample.depth_m:.1f} m, known {sample.depth_valid:.0%}"
        lines[-1] += f", beyond range {sample.beyond:.0%}"
        lines.append(f"  device poses: {_poses(seen)}")
    if sample.calibration is not None and sample.calibration.estimate is not None:
        lines.append(f"  depth against pictures: {describe(sample.calibration.estimate)}")
    if seen.placed is not None:
        lines.append(f"  found in the walk-through: {seen.placed:.0%} of the frames")
    if seen.moving is not None and role == "session":
        lines.append(f"  an animal moves in {seen.moving.seen:.0%} of the frames")
    lines += [f"  note: {remark}" for remark in recording.remarks]
    lines += [f"  {each.code} {each.what}\n    -> {each.remedy}" for each in found]
    return "\n".join(lines if found else [*lines, "  good"])


def _poses(seen: CaptureMeasurements) -> str:
    plan = seen.sample.plan
    assert plan is not None
    if plan.odometry_from_camera is None:
        return "none usable"
    check = plan.pose_check
    measured = math.isfinite(check.residual_m)
    residual = f"{1000 * check.residual_m:.0f} mm against depth" if measured else check.reason
    drift = f"{100 * seen.drift_m:.1f} cm between visits"
    drift = "no place seen twice" if math.isnan(seen.drift_m) else drift
    return f"{residual}, {drift}, gravity {'known' if plan.gravity_known else 'unknown'}"
