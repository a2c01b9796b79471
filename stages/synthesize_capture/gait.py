"""From the animal's trajectory to its bones: footfalls, postures, limbs by inverse kinematics, head and tail.

`footfalls` plants each foot for the part of the stride that it carries weight: while planted it does not
move in the world. `poses` then places the body, reaches the feet with the legs, and turns head and tail.
Everything is a closed function of time, vectorized over the queried times.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from pipeline.geometry import rigid
from stages.synthesize_capture.anatomy import Anatomy, Gait
from stages.synthesize_capture.animal import BONES, CAT, INDEX
from stages.synthesize_capture.session import AnimalCourse

Places = Float[np.ndarray, "frame 3"]
Direction = Float[np.ndarray, "3"]
FEET = ("left hand", "right hand", "left toes", "right toes")


@dataclass(frozen=True)
class AnimalMotion:
    """The animal's body at some times: root in the world and bones in the agent frame."""

    world_from_agent: Float[np.ndarray, "frame 4 4"]
    agent_from_bone: Float[np.ndarray, "frame bone 4 4"]


@dataclass(frozen=True)
class Rig:
    """The bones of a species being posed, agent frame."""

    anatomy: Anatomy
    bones: Float[np.ndarray, "frame bone 4 4"]

    def length(self, name: str) -> float:
        """Return the length of a bone."""
        return float(np.linalg.norm(self._axis(name)))

    def joint(self, name: str, parent: str) -> Float[np.ndarray, "frame 3"]:
        """Return the position of a bone's joint on its posed parent."""
        index, above = INDEX[name], INDEX[parent]
        offset = self.anatomy.heads[index] - self.anatomy.heads[above]
        return self.bones[:, above, :3, 3] + np.einsum("fij,j->fi", self.bones[:, above, :3, :3], offset)

    def hang(self, name: str, parent: str, rotation: Float[np.ndarray, "frame 3 3"]) -> None:
        """Attach a bone to its parent's joint with a rotation in the agent frame."""
        self.bones[:, INDEX[name], :3, :3] = rotation
        at = self.joint(name, parent) if parent else self.anatomy.heads[INDEX[name]]
        self.bones[:, INDEX[name], :3, 3] = at

    def two_bones(self, first: str, second: str, start: Places, end: Places, *, pole: Direction) -> None:
        """Solve two-bone inverse kinematics between two points, with the middle joint towards ``pole``."""
        a, b = self.length(first), self.length(second)
        axis = end - start
        distance = np.clip(np.linalg.norm(axis, axis=-1), abs(a - b) + 1e-4, a + b - 1e-5)
        axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
        side = pole - (axis @ pole)[:, None] * axis
        side /= np.linalg.norm(side, axis=-1, keepdims=True)
        cosine = np.clip((a * a + distance**2 - b * b) / (2 * a * distance), -1, 1)
        middle = start + a * (cosine[:, None] * axis + np.sqrt(1 - cosine**2)[:, None] * side)
        self.aim(first, start, middle, pole=pole)
        self.aim(second, middle, end, pole=pole)

    def aim(self, name: str, head: Places, tail: Places, *, pole: Direction) -> None:
        """Place a bone at ``head`` pointing to ``tail``, with the rest pose's roll relative to ``pole``."""
        rest = _axes(self._axis(name)[None], pole)
        self.bones[:, INDEX[name], :3, :3] = _axes(tail - head, pole) @ np.swapaxes(rest, -1, -2)
        self.bones[:, INDEX[name], :3, 3] = head

    def mostly_level(self, parent: str) -> Float[np.ndarray, "frame 3 3"]:
        """Keep a paw nearly level: apply a quarter of its parent's rotation."""
        turn = rigid.vector_from_rotation(self.bones[:, INDEX[parent], :3, :3])
        return rigid.rotation_from_vector(0.25 * turn)

    def _axis(self, name: str) -> Float[np.ndarray, "3"]:
        bone = self.anatomy.bones[INDEX[name]]
        return np.array(bone.tail, float) - np.array(bone.head, float)


def poses(
    course: AnimalCourse, timestamp_s: Float[np.ndarray, "frame"], anatomy: Anatomy = CAT
) -> AnimalMotion:
    """Return root and bones of a species at the given times.

    One whose bones are larger than its rows moves as those would over a course that is as much smaller.
    """
    size = anatomy.size
    if size != 1.0:
        smaller = replace(course, position=course.position / size, gaze=course.gaze / size)
        motion = poses(smaller, timestamp_s, replace(anatomy, size=1.0))
        scaled = [each.copy() for each in (motion.world_from_agent, motion.agent_from_bone)]
        for each in scaled:
            each[..., :3, 3] *= size
        return AnimalMotion(*scaled)
    state = _sampled(course, timestamp_s, anatomy.gait)
    world_from_agent = _root(state, timestamp_s, anatomy.gait)
    feet_world = footfalls(course, timestamp_s, anatomy)
    feet_agent = rigid.apply(rigid.inverse(world_from_agent), feet_world)
    feet_agent = _posed_feet(feet_agent, world_from_agent, state, anatomy)
    frames = len(timestamp_s)
    rig = Rig(anatomy, np.broadcast_to(np.eye(4), (frames, len(BONES), 4, 4)).copy())
    _bend_spine(rig, state)
    _turn_head(rig, world_from_agent, state)
    _swing_tail(rig, state, timestamp_s)
    for index, side in enumerate(("left", "right")):
        if anatomy.gait.wings:
            _wing(rig, side, state, timestamp_s)
        else:
            _fore_limb(rig, side, feet_agent[:, index])
        _hind_limb(rig, side, feet_agent[:, 2 + index])
    return AnimalMotion(world_from_agent, rig.bones)


def _neutral(anatomy: Anatomy) -> Float[np.ndarray, "foot 3"]:
    """Return the neutral positions of the feet under the body, agent frame."""
    fore, hind = anatomy.gait.forward
    forward = np.repeat([[0, 0, fore], [0, 0, hind]], 2, axis=0)
    return anatomy.heads[[INDEX[name] for name in FEET]] + forward


def footfalls(
    course: AnimalCourse, timestamp_s: Float[np.ndarray, "frame"], anatomy: Anatomy = CAT
) -> Float[np.ndarray, "frame foot 3"]:
    """Return the feet's world positions (bone heads of hands and toes) from the rhythm of the gait alone."""
    phase, duty, offset, lift = _rhythm(course, anatomy.gait)
    neutral, contact = _neutral(anatomy), _ground_contact(course, timestamp_s)
    neutral[:, 1] = anatomy.gait.sole_m
    placed = np.zeros((len(timestamp_s), 4, 3))
    for foot in range(4):
        cycle = np.maximum.accumulate(phase + offset[:, foot])
        now = np.interp(timestamp_s, course.timestamp_s, cycle)
        carry = np.interp(timestamp_s, course.timestamp_s, duty)
        index = np.floor(now)
        share = np.clip((now - index - carry) / (1 - carry), 0, 1)
        share = share * share * (3 - 2 * share)
        half = 0.5 * np.median(duty)
        here, there = (_planted(course, cycle, index + k, half, neutral[foot], contact) for k in (0, 1))
        placed[:, foot] = here + share[:, None] * (there - here)
        placed[:, foot, 1] += 4 * share * (1 - share) * np.interp(timestamp_s, course.timestamp_s, lift)
    return placed


def _rhythm(course: AnimalCourse, gait: Gait) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return stride phase, duty factor, phase offset per foot, and lift of the feet (meters)."""
    step = float(course.timestamp_s[1] - course.timestamp_s[0])
    speed = gaussian_filter1d(np.where(course.airborne > 0.5, 0.0, course.speed()), 0.08 / step)
    turn = gaussian_filter1d(np.abs(np.gradient(course.yaw, step)), 0.08 / step)
    drive = speed + 0.12 * turn
    frequency = (1.3 + 1.0 * drive) * np.clip((drive - 0.03) / 0.1, 0, 1)
    phase = np.cumsum(frequency) * step
    trot = gaussian_filter1d(np.clip((speed - 0.8) / 0.5, 0, 1), 0.25 / step)[:, None]
    duty = np.clip(gait.duty[0] - 0.16 * drive, *gait.duty[1:])
    offset = np.array(gait.walk_offset) * (1 - trot) + np.array(gait.trot_offset) * trot
    return phase, duty, offset, np.clip(0.03 + 0.025 * speed, 0.03, 0.07) * np.clip(drive / 0.15, 0, 1)


def _ground_contact(
    course: AnimalCourse, timestamp_s: Float[np.ndarray, "frame"]
) -> tuple[Float[np.ndarray, "frame"], Float[np.ndarray, "frame"]]:
    """Return when the last jump before each time ended and when the next one begins, seconds."""
    times, flying = course.timestamp_s, course.airborne > 0.5
    landed = np.maximum.accumulate(np.where(flying, times, times[0]))
    leaves = np.minimum.accumulate(np.where(flying, times, times[-1])[::-1])[::-1]
    nearest = np.clip(np.searchsorted(times, timestamp_s), 0, len(times) - 1)
    return landed[nearest], leaves[nearest]


def _planted(
    course: AnimalCourse,
    cycle: np.ndarray,
    index: np.ndarray,
    half_duty: float,
    neutral: np.ndarray,
    contact: tuple[np.ndarray, np.ndarray],
) -> Float[np.ndarray, "frame 3"]:
    """Return where a foot is planted in a stride: its neutral position at mid-stance.

    A stride that a jump interrupts ends at take-off, and the next one begins where the animal lands.
    """
    rising = cycle + 1e-9 * np.arange(len(cycle))
    when = np.clip(np.interp(index + half_duty, rising, course.timestamp_s), *contact)
    yaw = np.interp(when, course.timestamp_s, course.yaw)
    x, y, z = (np.interp(when, course.timestamp_s, course.position[:, axis]) for axis in range(3))
    side, sole, forward = neutral
    x, z = x + np.cos(yaw) * side + np.sin(yaw) * forward, z - np.sin(yaw) * side + np.cos(yaw) * forward
    return np.stack([x, y + sole, z], axis=-1)


@dataclass(frozen=True)
class _State:
    position: np.ndarray
    yaw: np.ndarray
    sit: np.ndarray
    lie: np.ndarray
    crouch: np.ndarray
    air: np.ndarray
    gaze: np.ndarray
    tail: np.ndarray
    speed: np.ndarray
    turn: np.ndarray
    phase: np.ndarray


def _sampled(course: AnimalCourse, timestamp_s: np.ndarray, gait: Gait) -> _State:
    def at(values: np.ndarray, smooth_s: float = 0.0) -> np.ndarray:
        values = values if values.ndim > 1 else values[:, None]
        if smooth_s:
            step_s = course.timestamp_s[1] - course.timestamp_s[0]
            values = gaussian_filter1d(values, smooth_s / step_s, axis=0)
        columns = [np.interp(timestamp_s, course.timestamp_s, values[:, k]) for k in range(values.shape[1])]
        return np.stack(columns, axis=-1) if len(columns) > 1 else columns[0]

    posture = at(course.posture)
    air = at(course.airborne, 0.05)
    return _State(
        at(course.position),
        at(course.yaw),
        posture[:, 0] * (1 - air),
        posture[:, 1] * (1 - air),
        posture[:, 2],
        air,
        at(course.gaze),
        at(course.tail, 0.25),
        at(course.speed(), 0.1),
        at(np.gradient(course.yaw, course.timestamp_s), 0.12),
        at(_rhythm(course, gait)[0]),
    )


def _root(state: _State, timestamp_s: np.ndarray, gait: Gait) -> Float[np.ndarray, "frame 4 4"]:
    height = gait.stand_m - 0.012 - 0.012 * np.clip(state.speed, 0, 1.5) - 0.05 * state.crouch
    stand = 1 - state.sit - state.lie
    bob = 0.006 * np.sin(4 * np.pi * state.phase) * np.clip(state.speed, 0, 1)
    height = height * stand + gait.sit_m * state.sit + gait.lie_m * state.lie + bob
    hop = np.clip(state.speed / 0.4, 0, 1)
    height += gait.hop_m * hop * (0.5 - 0.5 * np.cos(2 * np.pi * state.phase))
    height += 0.0015 * np.sin(2 * np.pi * 0.45 * timestamp_s)
    run = np.clip(state.speed - 0.6, 0, 1)
    pitch = gait.sit_pitch * state.sit + 0.03 * np.sin(4 * np.pi * state.phase + 1.0) * run
    pitch = pitch - gait.hop_pitch * hop * np.sin(2 * np.pi * (state.phase - 0.1))
    roll = np.clip(0.05 * state.turn * state.speed, -0.12, 0.12)
    climb = np.gradient(state.position[:, 1], timestamp_s) if len(timestamp_s) > 1 else np.zeros(1)
    pitch = pitch - np.clip(0.35 * climb, -0.6, 0.6) * state.air
    rotation = _turn(1, state.yaw) @ _turn(0, pitch) @ _turn(2, -roll)
    return rigid.make(rotation, state.position + height[:, None] * [0, 1, 0])


def _posed_feet(
    feet_agent: np.ndarray, world_from_agent: np.ndarray, state: _State, anatomy: Anatomy
) -> Float[np.ndarray, "frame foot 3"]:
    """Blend planted feet with those of sitting, lying and jumping."""
    level_from_agent = _turn(1, -state.yaw) @ world_from_agent[:, :3, :3]
    ground = state.position[:, 1] - world_from_agent[:, 1, 3] + anatomy.gait.sole_m

    def on_ground(places: tuple[tuple[float, float], ...]) -> np.ndarray:
        level = np.zeros((len(ground), 4, 3))
        for foot, (x, z) in enumerate((sign * x, z) for x, z in places for sign in (1, -1)):
            level[:, foot] = np.stack([np.full_like(ground, x), ground, np.full_like(ground, z)], axis=-1)
        return np.einsum("fji,fkj->fki", level_from_agent, level)

    sitting, lying = on_ground(anatomy.gait.sitting), on_ground(anatomy.gait.lying)
    flying = _neutral(anatomy) + np.repeat([[0, 0.05, 0.07], [0, 0.03, -0.09]], 2, axis=0)
    sit, lie, air = (part[:, None, None] for part in (state.sit, state.lie, state.air))
    return (feet_agent * (1 - sit - lie) + sitting * sit + lying * lie) * (1 - air) + flying * air


def _bend_spine(rig: Rig, state: _State) -> None:
    """Bend the back into turns, round it when sitting, and flex it when running."""
    flex = rig.anatomy.gait.flex
    bend = flex * np.clip(0.10 * state.turn, -0.3, 0.3)
    run = np.clip((state.speed - 1.0) / 1.0, 0, 1) * 0.14 * np.sin(2 * np.pi * state.phase)
    arch = flex * (0.16 * state.sit + 0.08 * state.crouch + run)
    loin = np.broadcast_to(np.eye(3), (len(bend), 3, 3))
    chest = _turn(1, bend) @ _turn(0, 0.6 * arch - 0.12 * flex * state.sit)
    spine = _turn(1, -0.5 * bend) @ _turn(0, -0.6 * arch)
    pelvis = spine @ _turn(1, -0.5 * bend) @ _turn(0, -0.9 * arch)
    rig.hang("loin", "", loin)
    rig.hang("chest", "loin", chest)
    rig.hang("spine", "loin", spine)
    rig.hang("pelvis", "spine", pelvis)


def _turn_head(rig: Rig, world_from_agent: np.ndarray, state: _State) -> None:
    """Turn the head to the gaze, shared with the neck and within its limits."""
    gaze_agent = rigid.apply(rigid.inverse(world_from_agent), state.gaze[:, None])[:, 0]
    toward = gaze_agent - np.array(rig.anatomy.gait.eye)
    yaw = np.clip(np.arctan2(toward[:, 0], toward[:, 2]), -1.25, 1.25)
    pitch = np.clip(-np.arctan2(toward[:, 1], np.hypot(toward[:, 0], toward[:, 2])), -0.6, 0.75)
    neck_pitch = 0.35 * state.crouch - 0.1 * state.sit + 0.25 * np.clip((state.speed - 0.8) / 1.2, 0, 1)
    neck_pitch += rig.anatomy.gait.nod * np.sin(4 * np.pi * state.phase) * np.clip(state.speed / 0.4, 0, 1)
    neck = rig.bones[:, INDEX["chest"], :3, :3] @ _turn(1, 0.45 * yaw) @ _turn(0, 0.4 * pitch + neck_pitch)
    rig.hang("neck", "chest", neck)
    rig.hang("head", "neck", _turn(1, 0.95 * yaw) @ _turn(0, pitch))


def _swing_tail(rig: Rig, state: _State, timestamp_s: np.ndarray) -> None:
    """Carry the tail by mood and sway it; curl it round the body when sitting or lying."""
    rest = state.sit + state.lie
    base, much = rig.bones[:, INDEX["pelvis"], :3, :3], rig.anatomy.gait.tail_sway
    lift = (0.35 + 0.75 * state.tail) * (1 - rest) - 0.3 * rest + 0.45 * state.sit
    for index in range(5):
        wave = np.sin(2 * np.pi * (0.55 + 0.25 * np.abs(state.tail)) * timestamp_s - 0.7 * index)
        sway = 0.16 * wave * (1 + 0.5 * index)
        curl = 0.38 * rest * (index > 0)
        bend = (0.75 if index == 0 else 0.22) * lift
        base = base @ _turn(1, much * (sway * (1 - 0.7 * rest) + curl)) @ _turn(0, much * bend)
        rig.hang(f"tail {index + 1}", "pelvis" if index == 0 else f"tail {index}", base)


def _wing(rig: Rig, side: str, state: _State, timestamp_s: np.ndarray) -> None:
    """Fold a wing at the body, and beat it in the air."""
    beat = (1.1 if side == "left" else -1.1) * state.air * (0.5 + 0.5 * np.sin(2 * np.pi * 6 * timestamp_s))
    turned, above = rig.bones[:, INDEX["chest"], :3, :3] @ _turn(2, beat), "chest"
    for part in ("upper arm", "forearm", "hand"):
        rig.hang(f"{side} {part}", above, turned)
        above = f"{side} {part}"


def _fore_limb(rig: Rig, side: str, foot: Float[np.ndarray, "frame 3"]) -> None:
    upper, lower, hand = (f"{side} {part}" for part in ("upper arm", "forearm", "hand"))
    shoulder = rig.joint(upper, "chest")
    shoulder = _reach(shoulder, foot, rig.length(upper) + rig.length(lower))
    rig.two_bones(upper, lower, shoulder, foot, pole=np.array([0.0, 0.2, -1.0]))
    rig.bones[:, INDEX[hand], :3, :3] = rig.mostly_level(lower)
    rig.bones[:, INDEX[hand], :3, 3] = foot


def _hind_limb(rig: Rig, side: str, foot: Float[np.ndarray, "frame 3"]) -> None:
    thigh, shank, metatarsal, toes = (f"{side} {part}" for part in ("thigh", "shank", "foot", "toes"))
    hip, heads = rig.joint(thigh, "pelvis"), rig.anatomy.heads
    squeeze = np.clip((rig.anatomy.gait.fold_m - np.linalg.norm(foot - hip, axis=-1)) / 0.1, 0, 1)
    tilt = -np.clip(1.1 * (foot[:, 2] - hip[:, 2] - 0.0), -0.5, 0.5) + 0.85 * squeeze
    rest = heads[INDEX[metatarsal]] - heads[INDEX[toes]]
    hock = foot + np.einsum("fij,j->fi", _turn(0, -tilt), rest)
    hip = _reach(hip, hock, rig.length(thigh) + rig.length(shank))
    rig.two_bones(thigh, shank, hip, hock, pole=np.array([0.0, 0.2, 1.0]))
    rig.aim(metatarsal, hock, foot, pole=np.array([0.0, 0.0, 1.0]))
    rig.bones[:, INDEX[toes], :3, :3] = rig.mostly_level(metatarsal)
    rig.bones[:, INDEX[toes], :3, 3] = foot


def _axes(direction: np.ndarray, pole: np.ndarray) -> Float[np.ndarray, "frame 3 3"]:
    first = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    third = np.cross(first, np.broadcast_to(pole, first.shape))
    third /= np.maximum(np.linalg.norm(third, axis=-1, keepdims=True), 1e-9)
    return np.stack([first, np.cross(third, first), third], axis=-1)


def _reach(joint: np.ndarray, target: np.ndarray, length: float) -> np.ndarray:
    """Shift the joint (shoulder blade, hip) if the leg is too short for the step."""
    away = target - joint
    distance = np.linalg.norm(away, axis=-1, keepdims=True)
    return joint + away / np.maximum(distance, 1e-9) * np.clip(distance - 0.985 * length, 0, 0.09)


def _turn(axis: int, angle: Float[np.ndarray, "frame"]) -> Float[np.ndarray, "frame 3 3"]:
    vector = np.zeros((len(angle), 3))
    vector[:, axis] = angle
    return rigid.rotation_from_vector(vector)
