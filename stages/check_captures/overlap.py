"""Whether a recording shows the room of the walk-through: SIFT points lifted by depth, a rigid fit, agreement over time."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.space import align, cameras, rigid
from stages.check_captures.looking import Shot

POINTS = 600
RATIO = 0.8
WITHIN_M = 0.06
LEAST = 10
"""points that must agree for a frame to be placed"""
AGREE = (15.0, 0.6)
"""degrees and metres within which two frames mean the same place"""
TRIALS = 300


@dataclass(frozen=True)
class Described:
    """The SIFT points of one frame that have depth."""

    shot: Shot
    descriptors: Float[np.ndarray, "point 128"]
    points_camera: Float[np.ndarray, "point 3"]


def describe(shots: Sequence[Shot]) -> list[Described]:
    """Describe frames; those with too few points are left out."""
    sift, found = cv2.SIFT.create(POINTS), []
    for shot in shots:
        keypoints, descriptors = sift.detectAndCompute(shot.gray, None)
        if len(keypoints) < LEAST:
            continue
        ray = cameras.unproject(np.array([point.pt for point in keypoints]) + 0.5, shot.intrinsics)
        pixel, _ = cameras.project(ray, shot.depth_intrinsics)
        column, row = np.clip(np.floor(pixel).astype(int), 0, np.array(shot.depth.shape[::-1]) - 1).T
        z = shot.depth[row, column]
        if (z > 0).sum() >= LEAST:
            rooted = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-6))
            found.append(Described(shot, rooted[z > 0], (ray * z[:, None])[z > 0]))
    return found


def placed_share(walkthrough: Sequence[Described], session: Sequence[Described], rng: np.random.Generator) -> float:
    """Return the share (0..1) of session frames that are found in the walk-through, at places that agree with each other."""
    if not session or not walkthrough:
        return 0.0
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    votes = [_best_place(walkthrough, frame, matcher, rng) for frame in session]
    placed = [vote for vote in votes if vote is not None]
    if not placed or walkthrough[0].shot.odometry_from_camera is None or session[0].shot.odometry_from_camera is None:
        return len(placed) / len(session)
    places = np.stack(placed)
    degrees = np.degrees(rigid.rotation_angle(places[:, None, :3, :3], places[None, :, :3, :3]))
    meters = np.linalg.norm(places[:, None, :3, 3] - places[None, :, :3, 3], axis=-1)
    agreeing = int(((degrees < AGREE[0]) & (meters < AGREE[1])).sum(1).max())
    return agreeing / len(session) if agreeing >= 2 else 0.0


def _best_place(
    walkthrough: Sequence[Described], frame: Described, matcher: cv2.BFMatcher, rng: np.random.Generator
) -> Float[np.ndarray, "4 4"] | None:
    """Return where one frame puts its odometry in the walk-through's (4 x 4), or None where no walk-through frame fits."""
    best, place = LEAST - 1, None
    for known in walkthrough:
        pairs = matcher.knnMatch(frame.descriptors, known.descriptors, k=2)
        good = [(a.queryIdx, a.trainIdx) for a, b in (pair for pair in pairs if len(pair) == 2) if a.distance < RATIO * b.distance]
        if len(good) <= best:
            continue
        mine, theirs = np.array(good).T
        matched = (frame.points_camera[mine], known.points_camera[theirs])
        fitted, agree = align.ransac_rigid(*matched, threshold_m=WITHIN_M, iterations=TRIALS, rng=rng)
        if agree.sum() > best:
            best, place = int(agree.sum()), _in_odometry(known.shot, fitted, frame.shot)
    return place


def _in_odometry(known: Shot, known_from_frame: np.ndarray, frame: Shot) -> Float[np.ndarray, "4 4"]:
    if known.odometry_from_camera is None or frame.odometry_from_camera is None:
        return known_from_frame
    return known.odometry_from_camera @ known_from_frame @ rigid.inverse(frame.odometry_from_camera)
