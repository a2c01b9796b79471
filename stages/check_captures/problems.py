"""What may be wrong with a recording, as stable codes with one remedy each; with their thresholds.

CAP-001 to CAP-022 (cannot be read or used) come from `pipeline.recordings`; these here are warnings.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.calibration.recordings import as_given, describe
from pipeline.core.videos import Role
from stages.check_captures.moving_objects import MotionShare
from stages.check_captures.parallax import Parallax
from stages.check_captures.sampling import RecordingSample


@dataclass(frozen=True)
class CaptureProblem:
    """One problem with its remedy."""

    code: str
    what: str
    remedy: str


@dataclass(frozen=True)
class CaptureMeasurements:
    """Measurements of one recording; None if not measured."""

    sample: RecordingSample
    drift_m: float = np.nan
    """NaN if no place was revisited"""
    moving: MotionShare | None = None
    placed: float | None = None
    """share of frames localized in the walk-through, 0..1"""
    parallax: Parallax | None = None
    """of a walk-through without depth"""


SHORTEST_S: dict[Role, float] = {"walkthrough": 30.0, "turnaround": 8.0, "session": 15.0, "heldout": 5.0}
MAX_DARK, MAX_BLURRED, MIN_DEPTH, MAX_BEYOND, MAX_DAMAGED = 0.2, 0.25, 0.5, 0.2, 0.0
MAX_INCOMPLETE = 0.02
MAX_DRIFT_M = 0.10
MIN_PLACED = 0.05
MIN_SEEN = 0.25
MIN_LINKED, MIN_PARALLAX = 0.6, 0.3
MAX_SEVERAL, MAX_LARGE = 0.5, 0.06
LONGEST_GAP_S = 1.0
SPARSE_HZ = 5.0
REMEDIES = {
    "CAP-030": "copy it from the phone again",
    "CAP-032": "open the curtains, switch on the lights",
    "CAP-033": "move and turn more slowly, wipe the lens",
    "CAP-034": "keep the app in front, free some storage",
    "CAP-035": "record video; keyframes serve for the walk-through only",
    "CAP-036": "keep furniture of the walk-through in view; record with a LiDAR phone for measured depth",
    "CAP-037": "avoid mirrors, glass and black things; do not cover the sensor",
    "CAP-038": "stay within 4 m of floor, walls and animal",
    "CAP-039": "record it with a LiDAR phone, or let a session with depth go where it went",
    "CAP-050": "begin when tracking is ready; the build goes on without them, less surely",
    "CAP-051": "nothing to do; if pictures look wrong, report the app's version",
    "CAP-052": "move smoothly, keep textured things in view; the build repairs what depth shows",
    "CAP-053": "film the walk-through again and include this part of the room, or leave the file out",
    "CAP-054": "keep the animal in view; if it rests all the time, point at it with a prompt",
    "CAP-055": "keep other animals and people out, or point at the animal with a prompt",
    "CAP-056": "walk sideways instead of turning on the spot, slowly, along things with a pattern",
    "CAP-057": "copy the file unedited; check the unit of its depth, its intrinsics and what mirrored it",
    "CAP-058": "leave poses out that are not its own; else move slowly, along things with a pattern",
    "CAP-059": "film the room again with nobody in it; if nobody was there, ignore it (large panes of glass)",
}


def problems(seen: CaptureMeasurements, role: Role) -> list[CaptureProblem]:
    """Return what is wrong with a recording in its role, worst first."""
    found = _of_pictures(seen.sample, role) | _of_depth(seen, role)
    found |= _of_poses(seen) | _of_content(seen, role)
    remedies = REMEDIES | _remedies(seen, role)
    return [CaptureProblem(code, what, remedies[code]) for code, what in found.items()]


def _remedies(seen: CaptureMeasurements, role: Role) -> dict[str, str]:
    """Return the remedies that depend on the recording."""
    recording, plan, agreement = seen.sample.recording, seen.sample.plan, seen.sample.agreement
    found = {"CAP-031": f"record at least {SHORTEST_S[role]:.0f} s for a {role}"}
    if plan is not None and plan.pose_check.depth_factor != 1:
        found["CAP-050"] = "correct the unit of its depth (TUM: depth_scale.txt), or that of the other"
    elif recording.pose is None:
        found["CAP-050"] = "add poses if its app can store them; the build finds the cameras, less surely"
    if agreement is not None and agreement.better.endswith(("earlier", "later")):
        found["CAP-057"] = "they were not taken at one time: shift the time stamps (numbers) of one by that"
    depth = seen.sample.calibration
    if depth is not None and depth.estimate is not None and depth.clear:
        keys = ", ".join(f"{key} = {value}" for key, value in as_given(depth).items())
        found["CAP-060"] = f"to fix this, write {Path(recording.where).name}.depth.toml: {keys}"
        if depth.used != depth.clear:
            found["CAP-060"] = f"check what is given (is depth_from_color the inverse?); these fit: {keys}"
    return found


def _of_pictures(sample: RecordingSample, role: Role) -> dict[str, str]:
    found = {}
    if sample.recording.incomplete > MAX_INCOMPLETE:
        complete = f"{len(sample.recording.index)} of {sample.recording.listed} frames"
        found["CAP-030"] = f"only {complete} have their picture, depth and metadata: files are missing"
    elif sample.damaged > MAX_DAMAGED:
        found["CAP-030"] = f"{sample.damaged:.0%} of the pictures are damaged or missing"
    if sample.duration_s < SHORTEST_S[role]:
        found["CAP-031"] = f"only {int(10 * sample.duration_s) / 10:g} s long"
    if sample.dark > MAX_DARK:
        found["CAP-032"] = f"{sample.dark:.0%} of the pictures are dark"
    if sample.blurred > MAX_BLURRED:
        found["CAP-033"] = f"{sample.blurred:.0%} of the pictures are blurred"
    if sample.longest_gap_s > LONGEST_GAP_S and sample.rate_hz > 1:
        found["CAP-034"] = f"frames are missing for {sample.longest_gap_s:.1f} s"
    if sample.rate_hz < SPARSE_HZ and role != "walkthrough":
        found["CAP-035"] = f"only {sample.rate_hz:.1f} frames per second"
    return found


def _of_depth(seen: CaptureMeasurements, role: Role) -> dict[str, str]:
    sample, found = seen.sample, {}
    if sample.plan is None:
        return _of_pictures_alone(seen.parallax, role)
    if sample.depth_valid < MIN_DEPTH:
        found["CAP-037"] = f"{1 - sample.depth_valid:.0%} of the depth is unknown"
    if sample.beyond > MAX_BEYOND:
        found["CAP-038"] = f"{sample.beyond:.0%} of the depth is beyond the sensor's range"
    depth = sample.calibration
    same_unit = sample.plan.pose_check.depth_factor == 1
    if depth is not None and depth.estimate is not None and depth.clear and same_unit:
        used = "the build corrects it" if depth.used == depth.clear else "what is given is used nevertheless"
        what = describe(depth.estimate, depth.clear)
        found["CAP-060"] = f"depth is not aligned with the pictures: {what}; {used}"
    return found


def _of_pictures_alone(parallax: Parallax | None, role: Role) -> dict[str, str]:
    if role != "walkthrough":
        what = "there is no depth: it comes from the walk-through's map, the animal's is inferred"
        return {"CAP-036": what}
    mapped = "there is no depth: the room is mapped from pictures"
    found = {"CAP-039": f"{mapped}; without a session that has depth its scale is relative"}
    if parallax is not None and (parallax.linked < MIN_LINKED or parallax.with_parallax < MIN_PARALLAX):
        linked = f"{parallax.linked:.0%} of neighboring pictures show the same things"
        found["CAP-056"] = f"{linked}, {parallax.with_parallax:.0%} of these from elsewhere"
    return found


def _of_poses(seen: CaptureMeasurements) -> dict[str, str]:
    plan, found = seen.sample.plan, {}
    if plan is None:
        return found
    if plan.odometry_from_camera is None:
        return {"CAP-050": f"device poses are not used: {plan.pose_check.reason}"}
    if plan.pose_check.verdict == "other":
        found["CAP-051"] = plan.pose_check.reason
    agreement = seen.sample.agreement
    if agreement is not None and agreement.verdict == "contradict":
        found["CAP-057"] = f"its parts contradict each other: {agreement.reason} than as stored"
    elif agreement is not None and agreement.verdict == "unconfirmed":
        found["CAP-058"] = agreement.reason
    if seen.drift_m > MAX_DRIFT_M:
        found["CAP-052"] = f"device poses drift: {100 * seen.drift_m:.0f} cm between visits of one place"
    return found


def _of_content(seen: CaptureMeasurements, role: Role) -> dict[str, str]:
    found = {}
    if seen.placed is not None and seen.placed < MIN_PLACED:
        found["CAP-053"] = f"{seen.placed:.0%} of the frames are found in the walk-through"
    agree = seen.sample.agreement is not None and seen.sample.agreement.verdict == "agree"
    if role == "walkthrough" and seen.moving is not None and agree and not seen.drift_m > MAX_DRIFT_M:
        if seen.moving.large > MAX_LARGE:
            found["CAP-059"] = f"someone or something large moves in {seen.moving.large:.0%} of the frames"
    if seen.moving is not None and role == "session":
        if seen.moving.seen < MIN_SEEN:
            found["CAP-054"] = f"something of an animal's size moves in {seen.moving.seen:.0%} of the frames"
        if seen.moving.several > MAX_SEVERAL:
            found["CAP-055"] = f"two things move far apart in {seen.moving.several:.0%} of the frames"
    return found
