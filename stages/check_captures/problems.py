"""What may be wrong with a recording, as stable codes with one remedy each; thresholds stand beside them.

CAP-001 to CAP-022 (cannot be read or used) come from `pipeline.recordings`; these here are warnings.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.videos import Role
from stages.check_captures.looking import Look
from stages.check_captures.movers import Moving
from stages.check_captures.parallax import Parallax


@dataclass(frozen=True)
class Problem:
    """One thing to do better."""

    code: str
    what: str
    remedy: str


@dataclass(frozen=True)
class Seen:
    """Everything measured of one recording; None where it was not measured."""

    look: Look
    drift_m: float = np.nan
    """NaN where no place was seen twice"""
    moving: Moving | None = None
    placed: float | None = None
    """share of frames found in the walk-through, 0..1"""
    parallax: Parallax | None = None
    """of a walk-through without depth"""


SHORTEST_S: dict[Role, float] = {"walkthrough": 30.0, "turnaround": 8.0, "session": 15.0, "heldout": 5.0}
MOST_DARK, MOST_BLURRED, LEAST_DEPTH, MOST_BEYOND, MOST_DAMAGED = 0.2, 0.25, 0.5, 0.2, 0.0
MOST_DRIFT_M = 0.10
LEAST_PLACED = 0.05
LEAST_SEEN = 0.25
LEAST_LINKED, LEAST_TELLING = 0.6, 0.3
MOST_SEVERAL = 0.5
LONGEST_GAP_S = 1.0
SPARSE_HZ = 5.0


def problems(seen: Seen, role: Role) -> list[Problem]:
    """Return what is wrong with a recording in its role, worst first."""
    return [*_of_pictures(seen.look, role), *_of_depth(seen, role), *_of_poses(seen), *_of_content(seen, role)]


def _of_pictures(look: Look, role: Role) -> list[Problem]:
    found = []
    if look.damaged > MOST_DAMAGED:
        found.append(Problem("CAP-030", f"{look.damaged:.0%} of the pictures are damaged", "copy it from the phone again"))
    if look.duration_s < SHORTEST_S[role]:
        found.append(Problem("CAP-031", f"only {look.duration_s:.0f} s long", f"record at least {SHORTEST_S[role]:.0f} s for a {role}"))
    if look.dark > MOST_DARK:
        found.append(Problem("CAP-032", f"{look.dark:.0%} of the pictures are dark", "open the curtains, switch on the lights"))
    if look.blurred > MOST_BLURRED:
        found.append(Problem("CAP-033", f"{look.blurred:.0%} of the pictures are blurred", "move and turn more slowly, wipe the lens"))
    if look.longest_gap_s > LONGEST_GAP_S and look.rate_hz > 1:
        found.append(Problem("CAP-034", f"frames are missing for {look.longest_gap_s:.1f} s", "keep the app in front, free some storage"))
    if look.rate_hz < SPARSE_HZ and role != "walkthrough":
        found.append(
            Problem("CAP-035", f"only {look.rate_hz:.1f} frames per second", "record video; keyframes serve for the walk-through only")
        )
    return found


def _of_depth(seen: Seen, role: Role) -> list[Problem]:
    look = seen.look
    if look.plan is None:
        return _of_pictures_alone(seen.parallax) if role == "walkthrough" else [_NO_DEPTH]
    found = []
    if look.depth_valid < LEAST_DEPTH:
        found.append(
            Problem(
                "CAP-037",
                f"{1 - look.depth_valid:.0%} of the depth is unknown",
                "avoid mirrors, glass and black things; do not cover the sensor",
            )
        )
    if look.beyond > MOST_BEYOND:
        found.append(
            Problem("CAP-038", f"{look.beyond:.0%} of the depth is beyond the sensor's range", "stay within 4 m of floor, walls and animal")
        )
    return found


_NO_DEPTH = Problem(
    "CAP-036",
    "there is no depth: the build stops at this file (CAP-006)",
    "record with a LiDAR phone, or add a depth picture per frame",
)


def _of_pictures_alone(parallax: Parallax | None) -> list[Problem]:
    what = "there is no depth: the room is mapped from pictures; without a session that has depth its scale is relative"
    found = [Problem("CAP-039", what, "record it with a LiDAR phone, or let a session with depth go where it went")]
    if parallax is not None and (parallax.linked < LEAST_LINKED or parallax.telling < LEAST_TELLING):
        what = f"{parallax.linked:.0%} of neighbouring pictures show the same things, {parallax.telling:.0%} of these from elsewhere"
        found.append(Problem("CAP-056", what, "walk sideways instead of turning on the spot, slowly, along things with a pattern"))
    return found


def _of_poses(seen: Seen) -> list[Problem]:
    plan = seen.look.plan
    if plan is None:
        return []
    check = plan.self_check
    if plan.odometry_from_camera is None:
        what = f"device poses are not used: {check.reason}"
        return [Problem("CAP-050", what, "begin to record when the app's tracking is ready; the build goes on without, less surely")]
    found = []
    if check.verdict == "other":
        found.append(Problem("CAP-051", check.reason, "nothing to do; if pictures look wrong, report the app's version"))
    if seen.drift_m > MOST_DRIFT_M:
        what = f"device poses drift: {100 * seen.drift_m:.0f} cm between visits of one place"
        found.append(Problem("CAP-052", what, "move smoothly, keep textured things in view; the build repairs what depth shows"))
    return found


def _of_content(seen: Seen, role: Role) -> list[Problem]:
    found = []
    if seen.placed is not None and seen.placed < LEAST_PLACED:
        what = f"{seen.placed:.0%} of the frames are found in the walk-through"
        found.append(Problem("CAP-053", what, "film the walk-through again and include this part of the room, or leave the file out"))
    if seen.moving is not None and role == "session":
        if seen.moving.seen < LEAST_SEEN:
            what = f"something of an animal's size moves in {seen.moving.seen:.0%} of the frames"
            found.append(Problem("CAP-054", what, "keep the animal in view; if it rests all the time, point at it with a prompt"))
        if seen.moving.several > MOST_SEVERAL:
            what = f"two things move far apart in {seen.moving.several:.0%} of the frames"
            found.append(Problem("CAP-055", what, "keep other animals and people out, or point at the animal with a prompt"))
    return found
