"""The masks of a recording: where the animal is (a ball per frame), what speaks for it (a judge), one sharp mask per frame.

`find_mover` and `judge_motion` serve sessions, `turnaround.find_standing` the turnaround; `learn_palette` and `paint` both.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.files.clips import Clip
from pipeline.space import cameras, rigid
from stages.segment_agent import free_space, movers, refine
from stages.segment_agent.free_space import FreeSpace, References, Votes
from stages.segment_agent.movers import Hint, Mover
from stages.segment_agent.refine import Palette, Refinement
from stages.segment_agent.windows import Sphere, Window, cut, working_size

STRIDE = 3


@dataclass(frozen=True)
class Evidence:
    """What a window's points say: log-odds of showing the animal, how much to trust them, and which are beyond doubt."""

    log_odds: Float[np.ndarray, "height width"]
    certainty: Float[np.ndarray, "height width"]
    animal: Bool[np.ndarray, "height width"]
    room: Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class Mask:
    """One frame's result at colour resolution."""

    labels: UInt8[np.ndarray, "height width"]
    visible: bool
    confidence: float


@dataclass(frozen=True)
class Weighing:
    """Log-odds that observations of a session are worth."""

    moving: float = 3.0
    """a point in space that is free at other times"""
    room: float = 3.0
    """a point on a surface that other frames saw"""
    step_m: float = 0.022
    """step in front of that surface that speaks neither way"""
    step_spread_m: float = 0.008
    """step that is worth one more"""
    recolored: float = 1.0
    """each time the noise by which such a surface's colour differs"""
    distrusted: float = 0.5
    """certainty of depth of low confidence or at a step; 1 is that of all other depth"""


Judge = Callable[[int, Window, Sphere], Evidence]


def find_mover(
    clip: Clip, world_from_camera: Float[np.ndarray, "frame 4 4"], references: References, free: FreeSpace, mover: Mover, hint: Hint | None
) -> list[Sphere | None]:
    """Track the moving animal of a session: a ball per frame, None where it is out of view."""
    found = []
    for frame in range(len(clip)):
        depth = free_space.usable_depth(clip, frame)[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
        rays = cameras.ray_directions(clip.depth_intrinsics[frame], *clip.depth_size)[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
        points = rigid.apply(world_from_camera[frame], (rays * depth[..., None]).reshape(-1, 3)).reshape(*depth.shape, 3)
        points[depth == 0] = np.nan
        votes = free_space.vote(references, points, free, frame)
        area = (depth * STRIDE) ** 2 / (clip.depth_intrinsics[frame, 0, 0] * clip.depth_intrinsics[frame, 1, 1])
        found.append(movers.candidates(movers.moving(votes, mover), points, area, mover))
    choice = movers.track(found, clip.timestamp_s, mover, hint)
    chosen = [group[index] if index >= 0 else None for group, index in zip(found, choice, strict=True)]
    radii = [candidate.radius_m for candidate in chosen if candidate]
    radius = float(np.clip(1.8 * np.quantile(radii, 0.9), 0.15, mover.largest_m)) if radii else 0.0
    return presume([Sphere(candidate.centre_world, radius) if candidate else None for candidate in chosen], clip.timestamp_s, mover)


def presume(balls: list[Sphere | None], timestamp_s: Float[np.ndarray, "frame"], mover: Mover) -> list[Sphere | None]:
    """Fill short gaps of a track between its ends, and a while before and after it, by where the animal may still be."""
    seen = np.array([frame for frame, ball in enumerate(balls) if ball is not None])
    if not len(seen):
        return balls
    centres = np.stack([balls[frame].centre_world for frame in seen])
    guess = np.stack([np.interp(timestamp_s, timestamp_s[seen], centres[:, axis]) for axis in range(3)], axis=1)
    wait = np.abs(timestamp_s[:, None] - timestamp_s[seen]).min(1)
    radius = balls[seen[0]].radius_m
    return [
        ball or (Sphere(guess[frame], radius, presumed=True) if wait[frame] < mover.presumed_s else None)
        for frame, ball in enumerate(balls)
    ]


def judge_motion(references: References, free: FreeSpace, mover: Mover, weighing: Weighing) -> Judge:
    """Evidence for sessions: free at other times is animal; on a surface that others saw is room.

    On such a surface a step towards the camera or another colour than the others saw there speaks for the animal: paws
    and tails are too thin for the depth sensor.
    """

    def judge(frame: int, window: Window, ball: Sphere) -> Evidence:
        known = np.isfinite(window.points_world[..., 0])
        near = np.linalg.norm(window.points_world - ball.centre_world, axis=-1) < ball.radius_m
        votes = free_space.vote(references, np.where(near[..., None], window.points_world, np.nan), free, frame)
        animal = movers.moving(votes, mover)
        settled = known & ~animal & (votes.occupied > 0)
        step = np.clip((votes.gap_m - weighing.step_m) / weighing.step_spread_m, -weighing.room, 1)
        log_odds = np.where(animal, weighing.moving, np.where(settled, step + weighing.recolored * recolored(window, votes, settled), 0.0))
        log_odds[known & ~near] = -weighing.room
        certainty = np.where(animal | settled | (known & ~near), np.where(window.trusted, 1.0, weighing.distrusted), 0.05)
        return Evidence(log_odds, certainty, animal & window.trusted, log_odds <= -0.66 * weighing.room)

    return judge


def recolored(window: Window, votes: Votes, settled: Bool[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Return by how many times the noise (0..6) a surface shows another colour than at other times, shadows taken out.

    A shadow or a changed exposure scales all channels alike, and a shadow only darkens.
    """
    if settled.sum() < 50:
        return np.zeros(settled.shape)
    now = cv2.GaussianBlur(window.color, (5, 5), 1.2).astype(np.float32)
    before = votes.color * np.median((now[settled] + 4) / (votes.color[settled] + 4), axis=0)
    scale = np.clip((now * before).sum(-1) / np.maximum((before**2).sum(-1), 1), 0.5, 1.0)
    difference = np.linalg.norm(now - scale[..., None] * before, axis=-1)
    noise = max(float(np.median(difference[settled])), 3.0)
    return np.where(settled, np.clip(difference / noise - 3, 0, 6), 0)


def learn_palette(
    clip: Clip, world_from_camera: np.ndarray, balls: list[Sphere | None], judge: Judge, options: Refinement, pictures: int = 30
) -> Palette:
    """Learn the animal's colours from frames spread over the recording."""
    palette = Palette()
    seen = [frame for frame, ball in enumerate(balls) if ball is not None and not ball.presumed]
    for frame in seen[:: max(1, len(seen) // pictures)]:
        window = cut(clip, frame, world_from_camera[frame], balls[frame], options.height_px)
        if window is not None:
            sure = judge(frame, window, balls[frame]).animal.astype(np.uint8)
            palette.learn(window.color[cv2.erode(sure, np.ones((3, 3), np.uint8)) > 0])
    return palette


def paint(
    clip: Clip,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    balls: list[Sphere | None],
    judge: Judge,
    palette: Palette,
    options: Refinement,
) -> Iterator[Mask]:
    """Make one mask per frame, in order."""
    for frame, ball in enumerate(balls):
        window = cut(clip, frame, world_from_camera[frame], ball, options.height_px) if ball is not None else None
        yield _paint_one(clip, frame, window, ball, judge, palette, options)


def _paint_one(
    clip: Clip, frame: int, window: Window | None, ball: Sphere | None, judge: Judge, palette: Palette, options: Refinement
) -> Mask:
    empty = np.zeros(clip.color_size, np.uint8)
    if window is None:
        return Mask(empty, False, 1.0)
    evidence = judge(frame, window, ball)
    color = options.color_weight * palette.ratio(window.color, evidence.room)
    log_odds = refine.sharpen(evidence.log_odds + color, evidence.certainty, window.color, options)
    labels = refine.label(log_odds, evidence.animal, options)
    least = options.least_presumed_px if ball.presumed else 1
    if evidence.animal[labels == 255].sum() < least:
        return Mask(empty, False, 0.5)
    whole = np.zeros(working_size(clip, options.height_px), np.uint8)
    whole[window.rows, window.columns] = labels
    sure = float(evidence.animal[labels == 255].mean())
    if whole.shape != clip.color_size:
        whole = cv2.resize(whole, clip.color_size[::-1], interpolation=cv2.INTER_NEAREST)
    return Mask(whole, True, sure)
