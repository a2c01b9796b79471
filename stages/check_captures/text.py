"""A recording and its problems as a few lines of text."""

import math
from collections.abc import Sequence
from pathlib import Path

from pipeline.core.errors import InputError
from pipeline.core.videos import Role
from stages.check_captures.problems import CaptureMeasurements, CaptureProblem


def describe_capture(
    name: str, role: Role, seen: CaptureMeasurements, found: Sequence[CaptureProblem]
) -> str:
    """Return a recording's format, measurements, and problems with remedies."""
    sample, recording = seen.sample, seen.sample.recording
    height, width = recording.color_size
    lines = [
        f"{name}  {role}, {recording.kind}",
        f"  {sample.duration_s:.1f} s, {sample.rate_hz:.1f} fps, {width} x {height}, {_turn(seen)}",
    ]
    lines.append(f"  pictures: dark {sample.dark:.0%}, blurred {sample.blurred:.0%}")
    if sample.plan is not None:
        lines[-1] += f"; depth: typically {sample.depth_m:.1f} m, known {sample.depth_valid:.0%}"
        lines[-1] += f", beyond range {sample.beyond:.0%}"
        lines.append(f"  device poses: {_poses(seen)}")
    if seen.placed is not None:
        lines.append(f"  found in the walk-through: {seen.placed:.0%} of the frames")
    if seen.moving is not None and role == "session":
        lines.append(f"  an animal moves in {seen.moving.seen:.0%} of the frames")
    lines += [f"  note: {remark}" for remark in recording.remarks]
    lines += [f"  {each.code} {each.what}\n    -> {each.remedy}" for each in found]
    return "\n".join(lines if found else [*lines, "  good"])


def refused(path: Path, role: Role, error: InputError) -> str:
    """Return why a recording is unusable, and because of which file."""
    file = error.where.removeprefix(str(path)).lstrip("/:") if error.where.startswith(str(path)) else ""
    what = f"{file}: {error.what}" if file else error.what
    return f"{path.name}  {role}\n  {error.code} {what}\n    -> {error.remedy}"


def _turn(seen: CaptureMeasurements) -> str:
    turns = seen.sample.plan.quarter_turns if seen.sample.plan else seen.sample.recording.quarter_turns
    return f"turned {90 * turns} deg clockwise to be upright" if turns else "upright as stored"


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
