"""Write the script of every recording: who is where, under which light, filmed by which phone.

`scripts` decides everything random apart from sensor noise, so that recordings can be filmed in any order.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.space import cameras, rigid
from stages.synthesize_capture import camera_motion, dwellings, gait, light, sensor, session
from stages.synthesize_capture.gait import Motion
from stages.synthesize_capture.light import Hour, Light
from stages.synthesize_capture.room import Room
from stages.synthesize_capture.sensor import Exposure
from stages.synthesize_capture.session import AnimalCourse, SessionTrajectories


@dataclass(frozen=True)
class Plan:
    """Which recordings to make; see the stage's Config for units."""

    seed: int
    session_count: int
    session_s: float
    test_session_s: float
    walkthrough_s: float
    turnaround_s: float
    heldout_of: int
    record_fps: float
    dim_session: int
    sideways_session: int
    harsh_session: int
    foreign_sessions: int
    color_height: int
    color_width: int
    depth_height: int
    depth_width: int


@dataclass(frozen=True)
class Script:
    """All that a recording shows, frame by frame, before the sensor."""

    name: str
    seed: int
    """Of the sensor's noise and the light map's sampling."""
    room: Room
    light: Light
    exposure: Exposure
    timestamp_s: Float[np.ndarray, "frame"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    """Stored canvas, OpenCV axes."""
    intrinsics: Float[np.ndarray, "frame 4"]
    """fx, fy, cx, cy in stored colour pixels."""
    odometry_from_camera: Float[np.ndarray, "frame 4 4"]
    gain: Float[np.ndarray, "frame"]
    motion: Motion | None
    moving: np.ndarray
    quarter_turns: int
    """Clockwise turns that make the stored picture upright."""
    color_size: tuple[int, int]
    depth_size: tuple[int, int]
    fps: float
    session: SessionTrajectories | None = None


MOVING_M_S = 0.15
"""Above this speed over ground the animal counts as moving."""


def scripts(plan: Plan, room: Room) -> list[Script]:
    """Write all scripts: walk-through, turnaround, sessions, and the second phone of one session."""
    streams = iter(np.random.default_rng([plan.seed, 1]).spawn(4 * plan.session_count + 16 + plan.foreign_sessions))
    day = light.light_of_session(next(streams), "day")
    rng = next(streams)
    out = [
        _script(
            plan,
            rng,
            "walkthrough",
            room,
            day,
            camera_motion.walkthrough(room, rng, plan.walkthrough_s),
            plan.walkthrough_s,
        )
    ]
    rng = next(streams)
    course = session.standing_course(room, rng, plan.turnaround_s)
    out.append(_script(plan, rng, "turnaround", room, day, camera_motion.turnaround(course, rng), plan.turnaround_s, course=course))
    for number in range(1, plan.session_count + 1):
        rng = next(streams)
        seconds = plan.test_session_s if number == plan.session_count else plan.session_s
        arranged = room.arranged(rng)
        hour: Hour = {plan.dim_session: "evening", plan.harsh_session: "sunset"}.get(number, "day")
        lit = light.light_of_session(rng, hour)
        lived = session.simulate_session(arranged, rng, seconds)
        path = camera_motion.filming(lived, rng)
        turns = 1 if number == plan.sideways_session else 0
        out.append(
            _script(
                plan,
                rng,
                f"session-{number}",
                arranged,
                lit,
                path,
                seconds,
                course=lived.animal,
                lived=lived,
                hour=hour,
                turns=turns,
            )
        )
        rng = next(streams)
        if number == plan.heldout_of:
            path = camera_motion.bystanding(lived, arranged, rng)
            out.append(_script(plan, rng, "heldout", arranged, lit, path, seconds, course=lived.animal, hour=hour))
    return [*out, *_foreign(plan, streams)]


def _foreign(plan: Plan, streams: Iterator[np.random.Generator]) -> Iterator[Script]:
    """Write the sessions of other homes; those of this one are the same with and without them."""
    for number in range(plan.session_count + 1, plan.session_count + plan.foreign_sessions + 1):
        rng = next(streams)
        home = dwellings.filmed_elsewhere(rng)
        lived = session.simulate_session(home, rng, plan.session_s)
        lit, path = light.light_of_session(rng, "day"), camera_motion.filming(lived, rng)
        yield _script(plan, rng, f"session-{number}", home, lit, path, plan.session_s, course=lived.animal, lived=lived)


def _script(
    plan: Plan,
    rng: np.random.Generator,
    name: str,
    room: Room,
    lit: Light,
    path: camera_motion.Cameras,
    duration_s: float,
    *,
    course: AnimalCourse | None = None,
    lived: SessionTrajectories | None = None,
    hour: Hour = "day",
    turns: int = 0,
) -> Script:
    timestamp_s = sensor.timestamps(rng, duration_s, plan.record_fps)
    upright = rigid.interpolate(np.arange(len(path)) * session.STEP_S, path, timestamp_s)
    stored = cameras.turn_camera(upright, -turns)
    exposure = sensor.exposure_of_recording(rng, hour)
    moving = np.zeros(len(timestamp_s), bool)
    if course is not None:
        moving = np.interp(timestamp_s, course.timestamp_s, course.speed()) > MOVING_M_S
    return Script(
        name=name,
        seed=int(rng.integers(2**31)),
        room=room,
        light=lit,
        exposure=exposure,
        timestamp_s=timestamp_s,
        world_from_camera=stored,
        intrinsics=sensor.lens(rng, timestamp_s, plan.color_width, plan.color_height),
        odometry_from_camera=sensor.odometry(rng, timestamp_s, stored),
        gain=sensor.gains(rng, timestamp_s, exposure),
        motion=None if course is None else gait.poses(course, timestamp_s),
        moving=moving,
        quarter_turns=turns,
        color_size=(plan.color_height, plan.color_width),
        depth_size=(plan.depth_height, plan.depth_width),
        fps=plan.record_fps,
        session=lived,
    )
