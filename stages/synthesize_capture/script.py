"""Write the script of every recording: who is where, under which light, filmed by which phone.

`scripts` decides everything random apart from sensor noise, so that recordings can be filmed in any order.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry import cameras, rigid
from stages.synthesize_capture import camera_motion, dwellings, gait, light, sensor, session
from stages.synthesize_capture.animal import BODIES
from stages.synthesize_capture.config import Config, Species
from stages.synthesize_capture.dog import DOG
from stages.synthesize_capture.gait import AnimalMotion
from stages.synthesize_capture.light import Hour, Light
from stages.synthesize_capture.room import Room
from stages.synthesize_capture.sensor import Exposure
from stages.synthesize_capture.session import AnimalCourse, SessionTrajectories
from stages.synthesize_capture.visitor import PERSON


@dataclass(frozen=True)
class PhoneFormat:
    """What the phone stores; a LiDAR phone's depth, and its color small enough to render on two cores."""

    fps: float = 15.0
    """Frames per second."""
    color_size: tuple[int, int] = (320, 240)
    """Height and width of the stored portrait canvas, pixels."""
    depth_size: tuple[int, int] = (256, 192)
    """Height and width of the stored depth, pixels."""


PHONE = PhoneFormat()


@dataclass(frozen=True)
class Script:
    """Content of a recording, frame by frame, before the sensor."""

    name: str
    seed: int
    """Seed of the sensor's noise and the light map's sampling."""
    room: Room
    light: Light
    exposure: Exposure
    timestamp_s: Float[np.ndarray, "frame"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    """Stored canvas, OpenCV axes."""
    intrinsics: Float[np.ndarray, "frame 4"]
    """fx, fy, cx, cy in stored color pixels."""
    odometry_from_camera: Float[np.ndarray, "frame 4 4"]
    gain: Float[np.ndarray, "frame"]
    motions: tuple[AnimalMotion | None, AnimalMotion | None, AnimalMotion | None]
    """Of the animal, of the companion and of a visitor, where they are there."""
    moving: tuple[Bool[np.ndarray, "frame"], Bool[np.ndarray, "frame"]]
    quarter_turns: int
    """Clockwise turns that make the stored picture upright."""
    phone: PhoneFormat
    session: SessionTrajectories | None = None


MOVING_M_S = 0.15
"""Minimum ground speed of a moving animal."""


def scripts(config: Config, room: Room, phone: PhoneFormat = PHONE) -> list[Script]:
    """Write all scripts: walk-through, turnaround, sessions, and the second phone of one session."""
    streams = iter(
        np.random.default_rng([config.seed, 1]).spawn(4 * config.session_count + 16 + config.foreign_sessions)
    )
    day = light.light_of_session(next(streams), "day")
    rng, seconds = next(streams), config.walkthrough_s
    path = camera_motion.walkthrough(room, rng, seconds)
    walkthrough = _script(phone, rng, "walkthrough", room, day, path, seconds)
    rng, seconds, species = next(streams), config.turnaround_s, config.species
    course = session.standing_course(room, rng, seconds)
    path = camera_motion.turnaround(course, rng)
    name = "turnaround" if config.companion == "none" else f"turnaround_{config.species}"
    turnarounds = [_script(phone, rng, name, room, day, path, seconds, course=course, species=species)]
    if config.companion != "none":
        rng = np.random.default_rng([config.seed, 4])
        course = session.standing_course(room, rng, seconds)
        path = camera_motion.turnaround(course, rng)
        name = f"turnaround_{config.companion}"
        turnarounds.append(_script(phone, rng, name, room, day, path, seconds, companion=course))
    sessions = _sessions(config, room, phone, streams)
    return [walkthrough, *turnarounds, *sessions, *_foreign(config, phone, streams)]


def _sessions(
    config: Config, room: Room, phone: PhoneFormat, streams: Iterator[np.random.Generator]
) -> Iterator[Script]:
    """Write the sessions of this home, and the second phone of one."""
    with_dog = config.companion != "none"
    for number in range(1, config.session_count + 1):
        rng, name = next(streams), f"session-{number}"
        hour: Hour = "evening" if number == config.dim_session else "day"
        seconds = config.test_session_s if number == config.session_count else config.session_s
        arranged = room.arranged(rng)
        lit = light.light_of_session(rng, hour)
        visited = number in config.visitor_sessions
        visitors = np.random.default_rng([config.seed, 5, number]) if visited else None
        lived = session.simulate_session(arranged, rng, seconds, with_dog=with_dog, visitors=visitors)
        path, turns = camera_motion.filming(lived, rng), int(number == config.sideways_session)
        seen = {"course": lived.animal, "companion": lived.companion, "visitor": lived.visitor}
        seen |= {"hour": hour, "species": config.species}
        yield _script(phone, rng, name, arranged, lit, path, seconds, lived=lived, turns=turns, **seen)
        rng = next(streams)
        if number == config.heldout_of:
            path = camera_motion.bystanding(lived, arranged, rng)
            yield _script(phone, rng, "heldout", arranged, lit, path, seconds, **seen)


def _foreign(config: Config, phone: PhoneFormat, streams: Iterator[np.random.Generator]) -> Iterator[Script]:
    """Write the sessions of other homes; those of this one are the same with and without them."""
    for number in range(config.session_count + 1, config.session_count + config.foreign_sessions + 1):
        rng, name, seconds = next(streams), f"session-{number}", config.session_s
        home = dwellings.filmed_elsewhere(rng)
        lived = session.simulate_session(home, rng, seconds)
        lit, path = light.light_of_session(rng, "day"), camera_motion.filming(lived, rng)
        seen = {"course": lived.animal, "lived": lived, "species": config.species}
        yield _script(phone, rng, name, home, lit, path, seconds, **seen)


def _script(
    phone: PhoneFormat,
    rng: np.random.Generator,
    name: str,
    room: Room,
    lit: Light,
    path: camera_motion.Cameras,
    duration_s: float,
    *,
    species: Species = "cat",
    course: AnimalCourse | None = None,
    companion: AnimalCourse | None = None,
    visitor: AnimalCourse | None = None,
    lived: SessionTrajectories | None = None,
    hour: Hour = "day",
    turns: int = 0,
) -> Script:
    timestamp_s = sensor.timestamps(rng, duration_s, phone.fps)
    upright = rigid.interpolate(np.arange(len(path)) * session.STEP_S, path, timestamp_s)
    stored = cameras.turn_camera(upright, -turns)
    exposure = sensor.exposure_of_recording(rng, hour)
    return Script(
        name=name,
        seed=int(rng.integers(2**31)),
        room=room,
        light=lit,
        exposure=exposure,
        timestamp_s=timestamp_s,
        world_from_camera=stored,
        intrinsics=sensor.lens(rng, timestamp_s, phone.color_size[1], phone.color_size[0]),
        odometry_from_camera=sensor.odometry(rng, timestamp_s, stored),
        gain=sensor.gains(rng, timestamp_s, exposure),
        motions=(
            None if course is None else gait.poses(course, timestamp_s, BODIES[species]),
            None if companion is None else gait.poses(companion, timestamp_s, DOG),
            None if visitor is None else gait.poses(visitor, timestamp_s, PERSON),
        ),
        moving=(_moving(course, timestamp_s), _moving(companion, timestamp_s)),
        quarter_turns=turns,
        phone=phone,
        session=lived,
    )


def _moving(course: AnimalCourse | None, timestamp_s: np.ndarray) -> np.ndarray:
    if course is None:
        return np.zeros(len(timestamp_s), bool)
    return np.interp(timestamp_s, course.timestamp_s, course.speed()) > MOVING_M_S
