"""What may be wrong with a recording, as stable codes with one remedy each; thresholds stand beside them.

CAP-001 to CAP-022 (cannot be read or used) come from `pipeline.recordings`; these here are warnings.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.core.videos import Role
from stages.check_captures.moving_objects import MotionShare
from stages.check_captures.parallax import Parallax
from stages.check_captures.sampling import RecordingSample


@dataclass(frozen=True)
class CaptureProblem:
    """One thing to do better."""

    code: str
    what: str
    remedy: str


@dataclass(frozen=True)
class CaptureMeasurements:
    """Everything measured of one recording; None where it was not measured."""

    sample: RecordingSample
    drift_m: float = np.nan
    """NaN where no place was seen twice"""
    moving: MotionShare | None = None
    placed: float | None = None
    """share of frames found in the walk-through, 0..1"""
    parallax: Parallax | None = None
    """of a walk-through without depth"""


SHORTEST_S: dict[Role, float] = {"walkthrough": 30.0, "turnaround": 8.0, "session": 15.0, "heldout": 5.0}
MOST_DARK, MOST_BLURRED, LEAST_DEPTH, MOST_BEYOND, MOST_DAMAGED = 0.2, 0.25, 0.5, 0.2, 0.0
MOST_DRIFT_M = 0.10
LEAST_PLACED = 0.05
LEAST_SEEN = 0.25
LEAST_LINKED, LEAST_PARALLAX = 0.6, 0.3
MOST_SEVERAL = 0.5
LONGEST_GAP_S = 1.0
SPARSE_HZ = 5.0


def problems(seen: CaptureMeasurements, role: Role) -> list[CaptureProblem]:
    """Return what is wrong with a recording in its role, worst first."""
    return [
        *_of_pictures(seen.sample, role),
        *_of_depth(seen, role),
        *_of_poses(seen),
        *_of_content(seen, role),
    ]


def _of_pictures(sample: RecordingSample, role: Role) -> list[CaptureProblem]:
    found = []
    if sample.damaged > MOST_DAMAGED:
        found.append(
            CaptureProblem(
                "CAP-030", f"{sample.damaged:.0%} of the pictures are damaged", "copy it from the phone again"
            )
        )
    if sample.duration_s < SHORTEST_S[role]:
        found.append(
            CaptureProblem(
                "CAP-031",
                f"only {sample.duration_s:.0f} s long",
                f"record at least {SHORTEST_S[role]:.0f} s for a {role}",
            )
        )
    if sample.dark > MOST_DARK:
        found.append(
            CaptureProblem(
                "CAP-032",
                f"{sample.dark:.0%} of the pictures are dark",
                "open the curtains, switch on the lights",
            )
        )
    if sample.blurred > MOST_BLURRED:
        found.append(
            CaptureProblem(
                "CAP-033",
                f"{sample.blurred:.0%} of the pictures are blurred",
                "move and turn more slowly, wipe the lens",
            )
        )
    if sample.longest_gap_s > LONGEST_GAP_S and sample.rate_hz > 1:
        found.append(
            CaptureProblem(
                "CAP-034",
                f"frames are missing for {sample.longest_gap_s:.1f} s",
                "keep the app in front, free some storage",
            )
        )
    if sample.rate_hz < SPARSE_HZ and role != "walkthrough":
        found.append(
            CaptureProblem(
                "CAP-035",
                f"only {sample.rate_hz:.1f} frames per second",
                "record video; keyframes serve for the walk-through only",
            )
        )
    return found


def _of_depth(seen: CaptureMeasurements, role: Role) -> list[CaptureProblem]:
    sample = seen.sample
    if sample.plan is None:
        return _of_pictures_alone(seen.parallax) if role == "walkthrough" else [_NO_DEPTH]
    found = []
    if sample.depth_valid < LEAST_DEPTH:
        found.append(
            CaptureProblem(
                "CAP-037",
                f"{1 - sample.depth_valid:.0%} of the depth is unknown",
                "avoid mirrors, glass and black things; do not cover the sensor",
            )
        )
    if sample.beyond > MOST_BEYOND:
        found.append(
            CaptureProblem(
                "CAP-038",
                f"{sample.beyond:.0%} of the depth is beyond the sensor's range",
                "stay within 4 m of floor, walls and animal",
            )
        )
    return found


_NO_DEPTH = CaptureProblem(
    "CAP-036",
    "there is no depth: cameras and depth come from the walk-through's map, the animal's is inferred",
    "keep furniture of the walk-through's room in view; record with a LiDAR phone for measured depth",
)


def _of_pictures_alone(parallax: Parallax | None) -> list[CaptureProblem]:
    what = (
        "there is no depth: the room is mapped from pictures; without a "
        "session that has depth its scale is relative"
    )
    found = [
        CaptureProblem(
            "CAP-039", what, "record it with a LiDAR phone, or let a session with depth go where it went"
        )
    ]
    if parallax is not None and (parallax.linked < LEAST_LINKED or parallax.with_parallax < LEAST_PARALLAX):
        what = (
            f"{parallax.linked:.0%} of neighbouring pictures show the same things, "
            f"{parallax.with_parallax:.0%} of these from elsewhere"
        )
        found.append(
            CaptureProblem(
                "CAP-056",
                what,
                "walk sideways instead of turning on the spot, slowly, along things with a pattern",
            )
        )
    return found


def _of_poses(seen: CaptureMeasurements) -> list[CaptureProblem]:
    plan = seen.sample.plan
    if plan is None:
        return []
    check = plan.pose_check
    if plan.odometry_from_camera is None:
        what = f"device poses are not used: {check.reason}"
        return [
            CaptureProblem(
                "CAP-050",
                what,
                "begin to record when the app's tracking is ready; the build goes on without, less surely",
            )
        ]
    found = []
    if check.verdict == "other":
        found.append(
            CaptureProblem(
                "CAP-051", check.reason, "nothing to do; if pictures look wrong, report the app's version"
            )
        )
    if seen.drift_m > MOST_DRIFT_M:
        what = f"device poses drift: {100 * seen.drift_m:.0f} cm between visits of one place"
        found.append(
            CaptureProblem(
                "CAP-052",
                what,
                "move smoothly, keep textured things in view; the build repairs what depth shows",
            )
        )
    return found


def _of_content(seen: CaptureMeasurements, role: Role) -> list[CaptureProblem]:
    found = []
    if seen.placed is not None and seen.placed < LEAST_PLACED:
        what = f"{seen.placed:.0%} of the frames are found in the walk-through"
        found.append(
            CaptureProblem(
                "CAP-053",
                what,
                "film the walk-through again and include this part of the room, or leave the file out",
            )
        )
    if seen.moving is not None and role == "session":
        if seen.moving.seen < LEAST_SEEN:
            what = f"something of an animal's size moves in {seen.moving.seen:.0%} of the frames"
            found.append(
                CaptureProblem(
                    "CAP-054",
                    what,
                    "keep the animal in view; if it rests all the time, point at it with a prompt",
                )
            )
        if seen.moving.several > MOST_SEVERAL:
            what = f"two things move far apart in {seen.moving.several:.0%} of the frames"
            found.append(
                CaptureProblem(
                    "CAP-055", what, "keep other animals and people out, or point at the animal with a prompt"
                )
            )
    return found
