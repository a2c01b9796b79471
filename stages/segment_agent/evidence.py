"""Per-pixel evidence of a window for the animal: free space first, and color change on static surfaces.

`motion_evidence` serves sessions; `turnaround` has the evidence of turnarounds.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields

import cv2
import numpy as np
from jaxtyping import Bool, Float

from stages.segment_agent import free_space, movers
from stages.segment_agent.free_space import References, Votes
from stages.segment_agent.windows import Sphere, Window


@dataclass(frozen=True)
class Evidence:
    """Log-odds that a window's pixels show the animal, their certainty 0..1, and which are beyond doubt."""

    log_odds: Float[np.ndarray, "height width"]
    certainty: Float[np.ndarray, "height width"]
    animal: Bool[np.ndarray, "height width"]
    moving: Bool[np.ndarray, "height width"]
    """clearly moving, at depth steps too"""
    seen_through: Bool[np.ndarray, "height width"]
    """moving in spite of the poses' drift, which makes rims of furniture move"""
    room: Bool[np.ndarray, "height width"]
    color_log_odds: Float[np.ndarray, "height width"] | float = 0.0
    """part of `log_odds` due to color change alone: thin paws and tails, but also gloss and shadows"""


MOVING, ROOM = 3.0, 3.0
"""log-odds of a point in space that is free at other times; the same against it on a static surface"""
STEP_M, STEP_SPREAD_M = 0.022, 0.008
"""depth step in front of a static surface at even log-odds, and the step per unit of log-odds, meters"""
COLOR_CHANGE_WEIGHT = 1.0
"""log-odds per standard deviation of color change of a static surface"""
UNTRUSTED_STATIC, UNTRUSTED_BEHIND, UNTRUSTED_MOVING = 0.5, 0.25, 0.6
"""certainty of depth of low confidence or at a step (other depth has 1): on static surfaces, elsewhere on the
background (the sensor may have missed a tail), and in space that is free at other times"""
UNKNOWN = 0.05
"""certainty where nothing is known: the neighborhood decides"""
SURE_ROOM = 0.66
"""share of `ROOM` beyond which a point is certainly background"""
MIN_STATIC_PX, MIN_NOISE = 50, 3.0
"""static pixels required to compare colors, and the least noise assumed (JPEG), gray levels"""
HALF_CERTAIN_VOTES = 5.0
"""number of references at which a static surface is half certain: one or two may have seen the animal"""
MISALIGNMENT_PX = 2
"""tolerated misalignment of textures, working pixels"""

EvidenceOf = Callable[[int, Window, Sphere], Evidence]


def motion_evidence(references: References) -> EvidenceOf:
    """Evidence for sessions: space that is free at other times is animal, surfaces seen by others are room.

    On such static surfaces a depth step towards the camera or a color change speaks for the animal: paws and
    tails are too thin for the depth sensor.
    """

    def evidence_of(frame: int, window: Window, sphere: Sphere) -> Evidence:
        known = np.isfinite(window.points_world[..., 0])
        near = np.linalg.norm(window.points_world - sphere.center_world, axis=-1) < sphere.radius_m
        points = np.where(near[..., None], window.points_world, np.nan)
        votes = free_space.vote(references, points, frame, surfaces=True)
        animal = movers.moving(votes)
        static = known & ~animal & (votes.occupied > 0)
        step = np.clip((votes.gap_m - STEP_M) / STEP_SPREAD_M, -ROOM, 1)
        color = np.where(static, COLOR_CHANGE_WEIGHT * color_change(window, votes, static), 0.0)
        log_odds = np.where(animal, MOVING, np.where(static, step + color, 0.0))
        elsewhere, seen = known & ~near, votes.occupied / (votes.occupied + HALF_CERTAIN_VOTES)
        doubted = np.where(animal, UNTRUSTED_MOVING, np.where(static, UNTRUSTED_STATIC, UNTRUSTED_BEHIND))
        certainty = np.where(static, seen, 1.0) * np.where(window.trusted, 1.0, doubted)
        log_odds[elsewhere], color[elsewhere] = -ROOM, 0.0
        certainty[~(animal | static | elsewhere)] = UNKNOWN
        moving, room = animal & movers.clearly_moving(votes), log_odds <= -SURE_ROOM * ROOM
        through = _seen_through(animal, points, references, frame)
        return Evidence(log_odds, certainty, animal & window.trusted, moving, through, room, color)

    return evidence_of


def _seen_through(
    animal: Bool[np.ndarray, "height width"],
    points_world: Float[np.ndarray, "height width 3"],
    references: References,
    frame: int,
) -> Bool[np.ndarray, "height width"]:
    """Return parts of ``animal`` that are wider than rims due to drift, and seen through in spite of it."""
    spacing_m = np.linalg.norm(np.diff(points_world, axis=1), axis=-1)[animal[:, 1:] & animal[:, :-1]]
    found, side_px = np.zeros(animal.shape, bool), 1
    if len(spacing_m):
        side_px += int(references.drift_m / np.median(spacing_m))
    opened = cv2.morphologyEx(animal.astype(np.uint8), cv2.MORPH_OPEN, np.ones((side_px,) * 2, np.uint8))
    for part in movers.components(opened > 0):
        found |= part & free_space.seen_through(references, points_world[part], frame)
    return found


def view_evidence(world_from_camera: Float[np.ndarray, "frame 4 4"]) -> EvidenceOf:
    """Evidence where depth was inferred from the same pictures: only against what a sphere does not cover."""

    def evidence_of(frame: int, window: Window, sphere: Sphere) -> Evidence:
        eye, none = world_from_camera[frame, :3, 3], np.zeros(window.trusted.shape, bool)
        ray = window.points_world - eye
        off_m = np.linalg.norm(np.cross(sphere.center_world - eye, ray), axis=-1)
        outside = off_m >= sphere.radius_m * np.linalg.norm(ray, axis=-1)
        log_odds, certainty = np.where(outside, -ROOM, 0.0), np.where(outside, 1.0, UNKNOWN)
        return Evidence(log_odds, certainty, none, none, none, outside)

    return evidence_of


def prefer_first(first: EvidenceOf, second: EvidenceOf) -> EvidenceOf:
    """Combine evidence: the first where it favors the animal, elsewhere the second."""

    def evidence_of(frame: int, window: Window, sphere: Sphere) -> Evidence:
        preferred, other = first(frame, window, sphere), second(frame, window, sphere)
        own, names = preferred.log_odds > 0, [part.name for part in fields(Evidence)]
        return Evidence(*(np.where(own, getattr(preferred, name), getattr(other, name)) for name in names))

    return evidence_of


def color_change(
    window: Window, votes: Votes, static: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width"]:
    """Return the color change of static surfaces against other times, in noise levels (0..6), less shadows.

    A shadow or an exposure change scales all channels alike, and a shadow only darkens. Colors within the
    range found up to `MISALIGNMENT_PX` away count as unchanged, since textures never align exactly.
    """
    if static.sum() < MIN_STATIC_PX:
        return np.zeros(static.shape)
    observed = cv2.GaussianBlur(window.color, (5, 5), free_space.BLUR_PX).astype(np.float32)
    reference = votes.color * np.median((observed[static] + 4) / (votes.color[static] + 4), axis=0)
    scale = np.clip((observed * reference).sum(-1) / np.maximum((reference**2).sum(-1), 1), 0.5, 1.0)
    expected, known = scale[..., None] * reference, static[..., None]
    kernel = np.ones((2 * MISALIGNMENT_PX + 1,) * 2, np.uint8)
    low = np.minimum(cv2.erode(np.where(known, expected, np.float32(np.inf)), kernel), expected)
    high = np.maximum(cv2.dilate(np.where(known, expected, np.float32(-np.inf)), kernel), expected)
    difference = np.linalg.norm(np.maximum(np.maximum(low - observed, observed - high), 0), axis=-1)
    noise = max(float(np.median(difference[static])), MIN_NOISE)
    return np.where(static, np.clip(difference / noise - 3, 0, 6), 0)
